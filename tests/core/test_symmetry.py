"""Turning a view: camera-space vectors turn along with the pixels."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade import symmetry
from deepshade.camera import Camera
from deepshade.gbuffer.geometry import normals_from_positions


def bumpy(size: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a smooth bumpy surface seen by a camera, and which are valid."""
    camera = Camera(50, size, size)
    y, x = np.mgrid[0:size, 0:size] / size
    depth = 3 + 0.4 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.5 * x + 0.2 * y
    return camera.position_from_depth(depth.astype(np.float32)), np.ones((size, size), bool)


@pytest.mark.parametrize("turn", symmetry.ALL)
def test_normals_from_turned_positions_are_turned_normals(turn: int) -> None:
    position, valid = bumpy()
    turned_normal = symmetry.apply(normals_from_positions(position, valid), "normal", turn)
    from_turned = normals_from_positions(symmetry.apply(position, "position", turn), valid)
    inner = (slice(None), slice(2, -2), slice(2, -2))
    dots = (turned_normal * from_turned)[inner].sum(0)
    assert dots.min() > 0.999


@pytest.mark.parametrize("turn", symmetry.ALL)
def test_turned_positions_still_lie_on_their_pixels_rays(turn: int) -> None:
    position, _ = bumpy()
    turned = symmetry.apply(position, "position", turn)
    rays = Camera(50, 48, 48).rays()
    assert np.allclose(turned, rays * -turned[2], atol=1e-5)


def test_the_eight_are_different_and_only_the_first_changes_nothing() -> None:
    position, _ = bumpy()
    images = [symmetry.apply(position, "position", k) for k in range(8)]
    assert (images[0] == position).all()
    for a in range(8):
        for b in range(a):
            assert np.abs(images[a] - images[b]).max() > 0.01


def test_motion_follows_its_pixels() -> None:
    # A motion to the right by one pixel, in an image whose columns count up.
    motion = np.zeros((2, 4, 4), np.float32)
    motion[0] = 1
    assert (symmetry.apply(motion, "motion", 1)[0] == -1).all()
    assert (symmetry.apply(motion, "motion", 4)[1] == 1).all()  # now down the rows
    assert (symmetry.apply(motion, "motion", 2)[0] == 1).all()


def test_colours_and_world_vectors_only_move() -> None:
    image = np.arange(27, dtype=np.float32).reshape(3, 3, 3)
    for name in (None, "diffuse", "normal_world"):
        assert sorted(symmetry.apply(image, name, 5).ravel()) == sorted(image.ravel())
        assert (symmetry.apply(image, name, 4) == image.swapaxes(1, 2)).all()


def test_rotations_are_the_turns_that_mirror_nothing() -> None:
    """A triangle of pixels keeps its sense of going round."""
    corners = np.zeros((1, 3, 3), np.float32)
    corners[0, 0, 0], corners[0, 0, 2], corners[0, 2, 2] = 1, 2, 3
    kept = []
    for turn in symmetry.ALL:
        image = symmetry.apply(corners, None, turn)[0]
        (a, b, c) = (np.argwhere(image == k)[0] for k in (1, 2, 3))
        across, down = b - a, c - b
        if across[1] * down[0] - across[0] * down[1] > 0:
            kept.append(turn)
    assert tuple(kept) == symmetry.ROTATIONS


def test_unknown_symmetries_are_refused() -> None:
    with pytest.raises(ValueError, match="0 to 7"):
        symmetry.apply(np.zeros((1, 2, 2)), None, 8)
