"""Pictures: encodings against their definitions."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepshade import pictures


def test_each_effect_says_how_it_is_shown() -> None:
    from deepshade.effects import EFFECTS

    image = np.array([[0.5]])
    assert pictures.of_effect(image, EFFECTS["ao"])[0, 0, 0] == 128
    assert pictures.of_effect(image, EFFECTS["gi"])[0, 0, 0] == 188


def test_srgb_at_known_values() -> None:
    # IEC 61966-2-1: 0.5 linear is 188, the toe is linear, the ends are the ends.
    image = np.array([[0.0, 0.0031308, 0.5, 1.0, 7.0, np.nan]], np.float32)
    assert pictures.srgb(image)[0, :, 0].tolist() == [0, 10, 188, 255, 255, 0]


def test_shading_is_linear_and_normals_have_their_colours() -> None:
    assert pictures.shading(np.array([[0.0, 0.5, 1.0]]))[0, :, 1].tolist() == [0, 128, 255]
    normal = np.zeros((3, 1, 2), np.float32)
    normal[2, 0, 0] = 1
    assert pictures.normals(normal)[0].tolist() == [[128, 128, 255], [0, 0, 0]]


def test_differences_are_red_where_too_bright_and_blue_where_too_dark() -> None:
    image, reference = np.array([[0.9, 0.5, 0.1]]), np.full((1, 3), 0.5)
    bright, equal, dark = pictures.difference(image, reference, gain=1)[0].astype(int)
    assert equal.tolist() == [255, 255, 255]
    assert bright[0] == 255 > bright[2]
    assert dark[2] == 255 > dark[0]


@pytest.mark.parametrize("channels", [1, 3])
def test_png_round_trip(tmp_path: Path, channels: int) -> None:
    image = np.random.default_rng(0).random((channels, 5, 7))
    picture = pictures.srgb(image)
    pictures.save(tmp_path / "new" / "a.png", picture)
    loaded = np.asarray(Image.open(tmp_path / "new" / "a.png").convert("RGB"))
    assert (loaded == picture).all()
    shape = np.asarray(Image.open(io.BytesIO(pictures.png(picture)))).shape
    assert shape == ((5, 7) if channels == 1 else (5, 7, 3))


def test_sheets() -> None:
    tile = np.zeros((4, 6, 3), np.uint8)
    row = pictures.beside([tile, tile])
    assert row.shape == (4, 6 + pictures.GAP + 6, 3)
    assert pictures.below([row, row, row]).shape == (12 + 2 * pictures.GAP, row.shape[1], 3)
