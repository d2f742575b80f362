"""Filters for motion blur against what a moving bar and things at rest have to look like."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .plates import noise, plates

try:
    from deepshade_report.baselines.mb import jimenez, mcguire
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

BOTH = [
    lambda taps: mcguire.mcguire(taps, mcguire.PUBLISHED),
    lambda taps: jimenez.jimenez(taps // 2, jimenez.PUBLISHED),
]


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


def bar(motion: float, *, across: bool = False, size: int = 128) -> tuple[View, Float]:
    """A bright bar, 40 wide, that moves before a dark wall, and the exact answer: a ramp."""
    inside = np.zeros((32, size), bool)
    inside[:, 44:84] = True
    depth = np.where(inside, 1.0, 4.0)
    moved = np.zeros((2, 32, size))
    moved[0, inside] = motion
    centre = np.arange(size) + 0.5
    # the share of the exposure in which the bar covers a pixel's centre
    starts, ends = centre - 84, centre - 44
    covered = np.clip(np.minimum(ends, motion / 2) - np.maximum(starts, -motion / 2), 0, None)
    exact = np.broadcast_to(0.1 + 0.9 * covered / motion, (3, 32, size))
    light = np.where(inside, 1.0, 0.1)
    if across:
        flip = (depth.T, moved[::-1].transpose(0, 2, 1), light.T, exact.transpose(0, 2, 1))
        depth, moved, light, exact = flip
    return plates("mb", motion=moved, depth=depth, light=light), np.asarray(exact)


@pytest.mark.parametrize("make", BOTH)
def test_what_rests_stays_as_it_is(make: Any) -> None:
    light = noise()
    view = plates("mb", motion=np.zeros((2, 32, 48)), depth=np.ones((32, 48)), light=light)
    assert (shaded(make(14), view) == light).all()


@pytest.mark.parametrize("make", BOTH)
def test_even_light_stays_even(make: Any) -> None:
    rng = np.random.default_rng(1)
    motion, depth = rng.normal(0, 20, (2, 32, 48)), rng.uniform(1, 5, (32, 48))
    empty = rng.random((32, 48)) < 0.2
    light = np.full((32, 48), 3e4)
    view = plates("mb", empty, motion=motion, depth=depth, light=light)
    assert shaded(make(14), view) == pytest.approx(3e4, rel=1e-5)


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("motion", [10.0, 32.0])
def test_a_moving_bar_leaves_a_ramp(motion: float, across: bool) -> None:
    view, exact = bar(motion, across=across)
    image = shaded(jimenez.jimenez(18, jimenez.PUBLISHED), view)
    found, expected = (x.mean(axis=2 if across else 1) for x in (image, exact))  # noise averaged
    assert np.abs(found - expected).mean() < 0.01
    assert np.abs(found - expected).max() < 0.06


def test_mcguire_s_normalised_weights_come_near_the_ramp() -> None:
    # They are no shares of time: the ramp is too steep, but most of its shape is there.
    view, exact = bar(32.0)
    image = shaded(mcguire.mcguire(35, mcguire.PUBLISHED), view)
    before = np.abs(view.attributes["light"] - exact).mean()
    assert np.abs(image.mean(1) - exact.mean(1)).mean() < 0.6 * before


@pytest.mark.parametrize("make", BOTH)
def test_forth_and_back_look_alike(make: Any) -> None:
    view, _ = bar(20.0)
    other, _ = bar(-20.0)
    other.attributes["light"][...] = view.attributes["light"]
    one, two = (shaded(make(24), v).mean(1) for v in (view, other))
    assert np.abs(one - two).mean() < 0.01


@pytest.mark.parametrize("make", BOTH)
def test_light_passes_linearly(make: Any) -> None:
    view, _ = bar(20.0)
    bright, _ = bar(20.0)
    bright.attributes["light"][...] *= 1e5
    assert shaded(make(14), bright) == pytest.approx(1e5 * shaded(make(14), view), rel=1e-4)


@pytest.mark.parametrize("make", BOTH)
def test_one_pixel(make: Any) -> None:
    one = np.ones((1, 1))
    view = plates("mb", motion=np.full((2, 1, 1), 9.0), depth=one, light=2 * one)
    assert shaded(make(14), view) == pytest.approx(2)


@pytest.mark.parametrize("module", [mcguire, jimenez])
def test_settings_go_from_cheap_to_best(module: Any) -> None:
    every, quick = module.methods(False), module.methods(True)
    taps = [next(iter(method.settings.values())) for method in every]
    assert taps == sorted(set(taps))
    assert len(quick) < len(every)
