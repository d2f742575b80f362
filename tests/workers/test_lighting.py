"""Direct light of a view's own lamp and sky, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers.backend import mitsuba
from deepshade_workers.lighting import direct_light
from deepshade_workers.sampling import split
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import View

from .conftest import lit, quad

mi = mitsuba()

LAMP = np.array([0.5, 1.5, 0.2])


@pytest.fixture(scope="module")
def floor() -> Scene:
    return Scene.from_mesh("floor", quad((0, 0, 0), (9, 0, 0), (0, 0, -9)))


def shaded(scene: Scene, camera: Camera, light: Any, *, samples: int = 64, seed: int = 1) -> Any:
    """L and L_diff, (N,) each of one channel, and the hits' positions (3, N)."""
    hits = trace(scene, camera, camera.width, camera.height)
    view = View(camera, 1.0, light=light)
    whole, part = direct_light(scene, view, hits, samples=samples, seed=seed)
    return whole[1].ravel(), part[1].ravel(), hits.p.numpy()


def irradiance(points: np.ndarray, intensity: float = 3.0) -> np.ndarray:
    """I cosθ / r² of the lamp on a floor that faces up."""
    toward = LAMP[:, None] - points
    distance = np.linalg.norm(toward, axis=0)
    return np.asarray(intensity * toward[1] / distance**3)


def test_a_point_lamp_falls_with_the_square_of_its_distance(floor: Scene, down: Camera) -> None:
    whole, part, points = shaded(floor, down, lit(LAMP, intensity=3))
    assert part == pytest.approx(0.7 / np.pi * irradiance(points), rel=1e-4)
    again, _, _ = shaded(floor, down, lit(LAMP, intensity=3), seed=2)
    assert whole == pytest.approx(again, rel=1e-6)  # it has no noise


def test_the_highlight_is_the_normalised_phong_lobe(floor: Scene, down: Camera) -> None:
    whole, part, points = shaded(floor, down, lit(LAMP, intensity=3))
    light = LAMP[:, None] - points
    mirrored = points - np.array([[0.0], [2], [0]])  # from the eye, then up again
    mirrored[1] *= -1
    cosine = (light * mirrored).sum(0) / np.linalg.norm(light, axis=0)
    cosine /= np.linalg.norm(mirrored, axis=0)
    lobe = 0.04 * 18 / (2 * np.pi) * np.maximum(cosine, 0) ** 16
    assert whole - part == pytest.approx(lobe * irradiance(points), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("size", [0.02, 1.0])
def test_a_sphere_above_the_horizon_lights_like_a_point(
    floor: Scene, down: Camera, size: float
) -> None:
    """π L sin²θ cos = I cos / d² exactly, at any distance, while no part of it sets."""
    _, part, points = shaded(floor, down, lit(LAMP, intensity=3, size=size), samples=256)
    assert part == pytest.approx(0.7 / np.pi * irradiance(points), rel=0.05)
    assert part.mean() == pytest.approx(0.7 / np.pi * irradiance(points).mean(), rel=1e-3)


def test_an_open_plane_under_a_uniform_sky_shows_its_reflectance(
    floor: Scene, down: Camera
) -> None:
    matte = quad((0, 0, 0), (9, 0, 0), (0, 0, -9), specular=(0.0, 0.0, 0.0))
    for scene, noise in ((Scene.from_mesh("matte", matte), 1e-5), (floor, 0.05)):
        _, part, _ = shaded(scene, down, lit(zenith=2, horizon=2))
        assert part == pytest.approx(np.full(part.shape, 1.4), rel=noise)
        assert part.mean() == pytest.approx(1.4, rel=2e-3)


def test_a_narrow_highlight_of_the_sky_has_little_noise() -> None:
    """What mirrors a uniform sky straight up is R_spec (n + 2)/2π ∫ cosⁿ⁺¹ dω = R_spec of it.

    Cosine-weighted directions alone would leave a standard error of twice that, with 64 of them.
    """
    white = (0.5, 0.5, 0.5)
    glossy = quad((0, 0, 0), (9, 0, 0), (0, 0, -9), specular=white, gloss=1000.0)
    camera = Camera.look_at((0, 50, 0), (0, 0, 0), (0, 0, -1), 1, 16, 16)
    whole, part, _ = shaded(Scene.from_mesh("glossy", glossy), camera, lit(zenith=2, horizon=2))
    assert whole - part == pytest.approx(np.full(part.shape, 1.0), rel=0.25)
    assert (whole - part).mean() == pytest.approx(1.0, rel=0.01)


def test_the_gradient_of_the_sky_integrates(floor: Scene, down: Camera) -> None:
    """2π ∫ (h + (z - h) μ²) μ dμ = π (h + z) / 2; the ground's light comes from below."""
    _, part, _ = shaded(floor, down, lit(zenith=3, horizon=1, ground=50))
    assert part.mean() == pytest.approx(0.7 * 2, rel=1e-3)


def test_where_nothing_is_the_sky_is_seen() -> None:
    scene = Scene.from_mesh("quad", quad((0, 0, -3), (0.1, 0, 0), (0, 0.1, 0)))
    camera = Camera.look_at((0, 0, 0), (0, 0, -1), (0, 1, 0), 90, 33, 33)
    whole, part, _ = shaded(scene, camera, lit(zenith=3, horizon=1, ground=0.2))
    rays = camera.rays().reshape(3, -1)
    height = rays[1] / np.linalg.norm(rays, axis=0)
    expected = np.where(height > 0, 1 + 2 * height**2, 1 - 0.8 * height**2)
    outside = np.abs(rays[:2]).max(0) > 0.1
    assert whole[outside] == pytest.approx(expected[outside], rel=1e-5)
    assert (part[outside] == 0).all()


def test_what_stands_between_casts_its_shadow(down: Camera) -> None:
    """A square halfway to a lamp at height 2 shades twice its size."""
    floor = quad((0, 0, 0), (9, 0, 0), (0, 0, -9))
    roof = quad((5, 1, 0), (0.2, 0, 0), (0, 0, -0.2))
    scene = Scene.from_mesh("roofed", merge([floor, roof]))
    over = Camera.look_at((4, 3, 0), (4, 0, 0), (0, 0, -1), 50, 64, 64)
    _, part, points = shaded(scene, over, lit((6, 2, 0), intensity=3))
    ground = np.abs(points[1]) < 1e-3
    apart = np.maximum(np.abs(points[0] - 4), np.abs(points[2]))
    assert (part[ground & (apart < 0.39)] == 0).all()
    assert (part[ground & (apart > 0.41)] > 0).all()


def test_a_choice_that_is_sure_holds_for_a_number_that_was_rounded_to_1() -> None:
    """(7 + the largest float below 1) / 8 is 1: metals, all specular, had pixels of NaN by it."""
    last = (mi.Float(7) + (1 - 2.0**-24)) / 8
    assert last.numpy() == 1
    chosen, rest = split(last, mi.Float(1))
    assert chosen.numpy() and 0 <= rest.numpy() < 1
    chosen, rest = split(last, mi.Float(0.5))
    assert not chosen.numpy() and 0 <= rest.numpy() < 1
