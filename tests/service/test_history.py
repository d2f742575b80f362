"""Temporal reprojection against what a moving camera and a moving bar must show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.gbuffer import GBuffer
from deepshade_service.live.history import History, _neighbourhood

WIDTH, HEIGHT, WALL, BAR = 96, 64, 6.0, 4.0


def camera(x: float) -> Camera:
    return Camera.look_at((x, 0, 0), (x, 0, -1), (0, 1, 0), 60, WIDTH, HEIGHT)


def wall(eye: Camera) -> tuple[GBuffer, np.ndarray]:
    """A wall before a camera, and on it a texture that is fixed to the world."""
    position = eye.position_from_depth(np.full((HEIGHT, WIDTH), WALL, np.float32))
    normal = np.zeros_like(position)
    normal[2] = 1
    world = position + eye.eye[:, None, None]
    texture = 0.5 + 0.3 * np.sin(2 * world[0]) * np.cos(3 * world[1])
    return gbuffer(position, normal, eye), texture[None].astype(np.float32)


def gbuffer(position: np.ndarray, normal: np.ndarray, eye: Camera | None) -> GBuffer:
    attributes: dict[str, Any] = {"position": position, "normal": normal}
    return GBuffer(attributes, np.zeros(position.shape[1:], np.bool_), eye)


def test_flicker_of_a_moving_camera_is_halved_and_the_picture_stays():
    """Grain that each frame has anew, on a texture that the camera passes by.

    Two pixels a frame, so that nothing is interpolated: blending keeps (1 - w) / (1 + w) of the
    grain's variance, 1/9 for w = .8, the sum of a geometric series.
    """
    rng, history = np.random.default_rng(0), History()
    given, kept = [], []
    for step in range(24):
        view, texture = wall(camera(step * 2 * WALL / camera(0).pixels_per_unit))
        grain = rng.normal(0, 0.05, texture.shape).astype(np.float32)
        found = history.blend("ao", texture + grain, view, None, alone=False)
        given.append(grain)
        kept.append(found - texture)
    inner = np.s_[:, 8:-8, 8:-8]
    late = slice(12, None)
    before = np.std([noise[inner] for noise in given[late]])
    after = np.std([noise[inner] for noise in kept[late]])
    assert after == pytest.approx(before / 3, rel=0.1)
    assert abs(np.mean([noise[inner] for noise in kept[late]])) < 0.005


def test_what_stands_still_stays_the_same():
    history = History()
    view, texture = wall(camera(0))
    for _ in range(5):
        found = history.blend("ao", texture, view, None, alone=False)
        np.testing.assert_allclose(found, texture, atol=1e-6)


def with_bar(left: int) -> tuple[GBuffer, np.ndarray, np.ndarray, np.ndarray]:
    """A bar of other brightness before the wall; (view, answer, where it is, motion)."""
    eye = camera(0)
    view, texture = wall(eye)
    there = np.zeros((HEIGHT, WIDTH), np.bool_)
    there[:, left : left + 12] = True
    depth = np.where(there, np.float32(BAR), np.float32(WALL))
    position = eye.position_from_depth(depth)
    stripes = (np.indices((HEIGHT, WIDTH))[1] - left) % 4 / 20  # its own texture moves along
    answer = np.where(there, 0.05 + stripes, texture).astype(np.float32)
    motion = np.zeros((2, HEIGHT, WIDTH), np.float32)
    motion[0][there] = 3
    return gbuffer(position, view.attributes["normal"], eye), answer, there, motion


@pytest.mark.parametrize("moves", [True, False])
def test_no_ghost_follows_a_bar_that_crosses_a_textured_wall(moves):
    """With its motion and without: behind it is the wall at once. With it the bar stays sharp."""
    history = History()
    for step in range(16):
        view, answer, there, motion = with_bar(8 + 3 * step)
        found = history.blend("ao", answer, view, motion if moves else None, alone=False)
        error = np.abs(found - answer)[0]
        assert error[~there].max() < 0.01
        if moves:
            assert error[there].max() < 0.01


def test_a_shadow_that_moves_on_the_wall_leaves_no_trail():
    """Same depth, same normal: only what lies around says that the old answer is no longer true."""
    history = History()
    worst = 0.0
    for step in range(16):
        view, answer = wall(camera(0))
        left = 8 + 4 * step
        answer[0, :, left : left + 12] *= 0.3
        found = history.blend("ao", answer.copy(), view, None, alone=False)
        behind = np.abs(found - answer)[0, :, : max(0, left - 8)]
        worst = max(worst, float(behind.max(initial=0)))
    assert worst < 0.06  # of .5


def test_cuts_other_sizes_and_other_effects_take_nothing_over():
    history = History()
    view, texture = wall(camera(0))
    history.blend("ao", np.zeros_like(texture), view, None, alone=False)
    np.testing.assert_array_equal(history.blend("ao", texture, view, None, alone=True), texture)
    history.blend("ao", np.zeros_like(texture), view, None, alone=True)
    small = gbuffer(*(view.attributes[name][:, ::2, ::2] for name in ("position", "normal")), None)
    np.testing.assert_array_equal(
        history.blend("ao", texture[:, ::2, ::2], small, None, alone=False), texture[:, ::2, ::2]
    )
    assert history.blend("dof", texture, view, None, alone=False) is texture


def test_the_neighbourhood_is_that_of_a_plain_loop():
    image = np.random.default_rng(1).normal(5, 2, (2, 9, 7)).astype(np.float32)
    mean, deviation = _neighbourhood(image, 2)
    padded = np.pad(image, ((0, 0), (2, 2), (2, 2)), "edge").astype(np.float64)
    for row, column in ((0, 0), (4, 3), (8, 6)):
        window = padded[:, row : row + 5, column : column + 5]
        np.testing.assert_allclose(mean[:, row, column], window.mean((1, 2)), rtol=1e-5)
    assert deviation.shape == image.shape
    assert np.all(_neighbourhood(np.full((1, 5, 5), 1e5, np.float32), 2)[1] == 0)
