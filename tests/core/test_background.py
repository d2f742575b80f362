"""Background and unusable pixels, against the definition pixel by pixel."""

import math

import numpy as np
import pytest

from deepshade.gbuffer import background

SPECIAL = [0.0, -0.0, 1.0, -1.0, 1e10, -1e10, 9e9, np.nan, np.inf, -np.inf, 1e-30]
CHANNELS = {
    "depth": 1,
    "distance": 1,
    "alpha": 1,
    "position": 3,
    "normal": 3,
    "normal_world": 3,
    "position_world": 3,
    "albedo": 3,
}


def shows_nothing(name, values):
    if name in ("depth", "distance"):
        return not 0 < values[0] < 1e10
    if name == "alpha":
        return values[0] <= 0
    if name == "position":
        return values[2] == 0 or not abs(values[2]) < 1e10
    return name != "albedo" and all(value == 0 for value in values)


def by_definition(arrays):
    shape = next(iter(arrays.values())).shape[1:]
    empty, broken = np.zeros(shape, bool), np.zeros(shape, bool)
    for at in np.ndindex(shape):
        pixel = {name: [float(v) for v in array[:, *at]] for name, array in arrays.items()}
        far = any(pixel[n][0] == math.inf for n in ("depth", "distance") if n in pixel)
        bad = not all(math.isfinite(v) for values in pixel.values() for v in values)
        broken[at] = bad and not far
        empty[at] = bad or any(shows_nothing(*item) for item in pixel.items())
    return empty, int(broken.sum())


@pytest.mark.parametrize("seed", range(40))
def test_agrees_with_the_definition(seed, monkeypatch):
    monkeypatch.setattr(background, "_BLOCK", 30)  # the picture is several blocks
    rng = np.random.default_rng(seed)
    names = rng.permutation(list(CHANNELS))[: rng.integers(1, 5)]
    arrays = {}
    for name in names:
        array = rng.normal(size=(CHANNELS[name], 9, 11)).astype(np.float32)
        if rng.random() < 0.3:
            array = np.abs(array) * (-1 if name == "position" else 1)
        odd = rng.random(array.shape) < rng.choice([0, 0.05, 0.6])
        some = SPECIAL[:7] if rng.random() < 0.5 else SPECIAL
        array[odd] = rng.choice(some, odd.sum()).astype(np.float32)
        if rng.random() < 0.5:
            array[:, rng.integers(9) :] = 0  # some blocks show nothing at all
        arrays[name] = array
    suspects = {name for name, array in arrays.items() if not np.isfinite(array).all()}
    before = {name: array.copy() for name, array in arrays.items()}
    expected, broken = by_definition(arrays)
    found, count = background.remove(arrays, suspects)
    np.testing.assert_array_equal(found, expected)
    assert count == broken
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, np.where(expected, 0, before[name]))


@pytest.mark.parametrize("share", [0, 0.5, 1])
def test_clear_leaves_zeros_and_nothing_else_changed(share):
    rng = np.random.default_rng(1)
    mask = rng.random((7, 5)) < share
    array = rng.normal(size=(3, 7, 5)).astype(np.float32)
    array[:, mask] = np.nan
    expected = np.where(mask, 0, array)
    background.clear(iter([array]), mask)
    np.testing.assert_array_equal(array, expected)
