"""Ambient occlusion against closed forms, its error estimate, and its noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers.references import ao
from deepshade_workers.sampling import rays_used, strata
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.procedural.primitives import box, place
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import View

from .conftest import quad


def occlusion(
    scene: Any, camera: Camera, *, radius: float = 1.0, samples: int = 256, seed: int = 1
) -> Any:
    """(1, N) value and error, and the hits."""
    hits = trace(scene, camera, camera.width, camera.height)
    found = ao.reference(scene, View(camera, radius), hits, {}, samples=samples, seed=seed)
    return [image.reshape(1, -1) for image in found], hits


def wall_visibility(distance: np.ndarray, radius: float = 1.0) -> np.ndarray:
    """Visibility on a plane at `distance` from an infinite perpendicular wall."""
    a = np.clip(distance / radius, 0, 1)
    return 1 - (np.arccos(a) - a * np.sqrt(1 - a * a)) / np.pi


def test_an_open_plane_sees_everything(down: Camera) -> None:
    scene = Scene.from_mesh("plane", quad((0, 0, 0), (50, 0, 0), (0, 0, -50)))
    (value, error), _ = occlusion(scene, down)
    assert (value == 1).all()
    assert (error == 0).all()


def test_a_wall_takes_what_the_closed_form_says(corner: Any) -> None:
    camera = Camera.look_at((0, 2, 0), (0, 0, -0.5), (0, 1, 0), 30, 96, 96)
    (value, error), hits = occlusion(corner, camera)
    on_floor = np.abs(hits.p.numpy()[1]) < 1e-3
    distance = hits.p.numpy()[2][on_floor] + 1
    expected = wall_visibility(distance)
    residual = value[0][on_floor] - expected
    # Each row of pixels has one distance: its mean must lie within 3 standard errors.
    for low in np.arange(0.1, 1.05, 0.1):
        row = (distance >= low) & (distance < low + 0.1)
        assert row.sum() > 250
        sigma = np.sqrt((error[0][on_floor][row] ** 2).sum()) / row.sum()
        assert abs(residual[row].mean()) <= 3 * sigma + 1e-9


def test_the_standard_error_is_the_spread_of_repeated_renders(corner: Any) -> None:
    camera = Camera.look_at((0, 2, 0), (0, 0, -0.6), (0, 1, 0), 20, 24, 24)
    runs = [occlusion(corner, camera, samples=64, seed=s)[0] for s in range(40)]
    spread = np.stack([value[0] for value, _ in runs]).var(0, ddof=1).mean()
    claimed = np.stack([error[0] ** 2 for _, error in runs]).mean()
    assert claimed == pytest.approx(spread, rel=0.1)


def test_deep_in_a_small_box_nothing_is_visible() -> None:
    inside = box().transformed(place(size=0.5))
    scene = Scene.from_mesh("box", inside)
    camera = Camera.look_at((0, 0, 0.1), (0, 0, -1), (0, 1, 0), 50, 16, 16)
    (value, error), hits = occlusion(scene, camera)
    assert hits.valid.numpy().all()
    assert (value == 0).all()
    assert (error == 0).all()


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_scaling_scene_and_radius_changes_nothing(scale: float) -> None:
    parts = [
        quad((0, 0, 0), (5, 0, 0), (0, 0, -5)),
        box().transformed(place((0.3, 0.4, -0.2), (0.7, 0.8, 0.5))),
        box().transformed(place((-0.6, 0.2, 0.3), 0.4)),
    ]
    values = []
    for factor in (1.0, scale):
        mesh = merge(parts).transformed(place(size=factor))
        eye, target = np.array([1.5, 2, 2]) * factor, np.array([0, 0.3, 0]) * factor
        camera = Camera.look_at(eye, target, (0, 1, 0), 45, 48, 48)
        (value, _), _ = occlusion(Scene.from_mesh("s", mesh), camera, radius=0.8 * factor)
        values.append(value[0])
    # The same random numbers: only rays that graze an edge may change sides.
    assert np.abs(values[0] - values[1]).mean() < 2e-4
    assert values[0].std() > 0.1


def test_background_is_open() -> None:
    scene = Scene.from_mesh("box", box())
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0), 50, 32, 32)
    (value, _), hits = occlusion(scene, camera)
    outside = ~hits.valid.numpy()
    assert outside.any()
    assert (value[0][outside] == 1).all()


def test_noise_has_no_pattern(corner: Any) -> None:
    camera = Camera.look_at((0, 2, 0), (0, 0, -0.5), (0, 1, 0), 10, 64, 64)
    noise = []
    for seed in (1, 2):
        (value, _), hits = occlusion(corner, camera, samples=16, seed=seed)
        residual = value[0] - wall_visibility(hits.p.numpy()[2] + 1)
        noise.append(residual.reshape(64, 64))
    bound = 4 / 64  # 4 standard deviations of a correlation over 64² independent pixels
    for a, b in (
        (noise[0][:, 1:], noise[0][:, :-1]),
        (noise[0][1:], noise[0][:-1]),
        (noise[0][8:], noise[0][:-8]),
        (noise[0], noise[1]),
    ):
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < bound


def test_the_same_seed_gives_the_same_image(corner: Any, down: Camera) -> None:
    first, second, other = (occlusion(corner, down, seed=s)[0][0] for s in (3, 3, 4))
    assert (first == second).all()
    assert (first != other).any()


@pytest.mark.parametrize(
    ("samples", "grid"),
    [(2, (1, 1)), (256, (16, 8)), (64, (8, 4)), (14, (3, 2)), (254, (11, 11)), (6, (3, 1))],
)
def test_strata_hold_two_samples_each(samples: int, grid: tuple[int, int]) -> None:
    assert strata(samples) == grid
    assert rays_used(samples) == 2 * grid[0] * grid[1] <= samples
