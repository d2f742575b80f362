"""Textures: reflectances that repeat, the same for the same seed, and none like another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade.errors import SceneError
from deepshade_workers.textures import GENERATORS, SIDE, draw_textures, pictures
from deepshade_workers.textures.patterns import cells, clouds

SIZE = 128


def made(name: str, seed: int = 3) -> np.ndarray:
    return GENERATORS[name](np.random.default_rng(seed), SIZE)


@pytest.mark.parametrize("name", GENERATORS)
def test_a_generator_makes_repeating_reflectance(name: str) -> None:
    for seed in (3, 4):
        image = made(name, seed)
        assert image.shape == (SIZE, SIZE, 3)
        assert np.isfinite(image).all()
        assert image.min() >= 0
        assert image.max() <= 1
        assert image.std() > 0.003
        for axis in (0, 1):  # the step over the border is like one of the steps within
            step = np.abs(image - np.roll(image, 1, axis)).mean((1 - axis, 2))
            assert step[0] <= 1.3 * step[1:].max() + 0.01
    assert (made(name) == made(name)).all()
    assert (made(name, 3) != made(name, 4)).any()


def test_there_are_dozens_and_no_two_alike() -> None:
    assert len(GENERATORS) >= 36
    flat = np.stack([made(name)[::8, ::8].ravel() for name in GENERATORS])
    apart = np.abs(flat[:, None] - flat[None]).mean(2) + np.eye(len(flat))
    assert apart.min() > 0.02


def test_clouds_are_about_uniform() -> None:
    values = np.sort(clouds(np.random.default_rng(1), 128, 4, 1.0).ravel())
    assert np.abs(values - np.linspace(0, 1, len(values))).max() < 0.06


def test_cells_give_the_distances_to_the_two_nearest_points() -> None:
    """On an unjittered lattice they are known."""
    first, second, _ = cells(np.random.default_rng(1), 60, 6, jitter=0.0)
    along = (np.arange(60) + 0.5) / 10 % 1 - 0.5
    expected = np.hypot(along, along[:, None])
    assert first == pytest.approx(expected)
    a, b = np.abs(along), np.abs(along)[:, None]
    assert second == pytest.approx(np.minimum(np.hypot(1 - a, b), np.hypot(a, 1 - b)))


def test_pictures_are_decoded_and_cut_outs_left_out(tmp_path: Path) -> None:
    Image.new("RGB", (20, 10), (188, 0, 255)).save(tmp_path / "a.png")
    Image.new("RGBA", (8, 8), (9, 9, 9, 9)).save(tmp_path / "b.png")
    (only,) = pictures(str(tmp_path), SIDE)
    assert only.shape == (SIDE, SIDE, 3)
    assert only[0, 0] == pytest.approx([0.503, 0, 1], abs=1e-3)
    drawn = draw_textures(np.random.default_rng(1), 8, str(tmp_path))
    assert 0 < sum(texture is only for texture in drawn) < 8
    with pytest.raises(SceneError, match="no opaque picture"):
        pictures(str(tmp_path / "none"), SIDE)
