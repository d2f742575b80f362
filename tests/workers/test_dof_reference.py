"""Depth of field, against the blur circle of a thin lens."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.gbuffer.derivation import circle_of_confusion
from deepshade_workers.backend import mitsuba
from deepshade_workers.lighting import direct_light
from deepshade_workers.references import dof
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import pixel_rays, trace
from deepshade_workers.view import View

from .conftest import assert_within, lit, matte, quad

mi = mitsuba()

DEPTH = 3.0
LAMP = lit((0, 0, 1e4), intensity=10003.0**2)
WHITE = 0.7 / np.pi  # of a matte surface that faces the lamp


@pytest.fixture(scope="module")
def ahead() -> Camera:
    return Camera.look_at((0, 0, 0), (0, 0, -1), (0, 1, 0), 50, 48, 48)


@pytest.fixture(scope="module")
def patch(ahead: Camera) -> Scene:
    """A square of 10 pixels a side; its edges lie between pixels' centres."""
    half = 5 * DEPTH / ahead.pixels_per_unit
    return Scene.from_mesh("patch", matte(quad((0, 0, -DEPTH), (half, 0, 0), (0, half, 0))))


def seen_through(
    scene: Scene,
    camera: Camera,
    light: Any,
    *,
    focus: float | None,
    aperture: float | None,
    samples: int = 256,
) -> Any:
    """(H, W) of one channel: value, error and the pinhole's L."""
    hits = trace(scene, camera, camera.width, camera.height)
    view = View(camera, 1.0, focus=focus, aperture=aperture, light=light)
    value, error = dof.reference(scene, view, hits, {}, samples=samples, seed=1)
    pinhole, _ = direct_light(scene, view, hits, samples=64, seed=1)
    return value[0], error[0], pinhole[0]


def blur(camera: Camera, depth: float, focus: float, aperture: float) -> float:
    """D_focal: the signed diameter of the circle, in pixels."""
    found = circle_of_confusion(np.array(depth), focus, aperture, camera.pixels_per_unit)
    return float(found)


@pytest.mark.parametrize("depth", [0.7, 1.5, 2.0, 9.0, 1e6])
def test_the_rim_of_the_lens_draws_the_analytic_circle(depth: float) -> None:
    """A turned and shifted camera: a ray through the rim is |D_focal| / 2 off at any depth."""
    camera = Camera.look_at((1, 2, 3), (0.3, -1, 0.2), (0.2, 1, 0), 40, 8, 6)
    view = View(camera, 1.0, focus=2.0, aperture=0.3)
    angle = dr.arange(mi.Float, 48)
    disc = mi.Point2f(dr.cos(angle), dr.sin(angle))
    ray = dof.lens_ray(view, pixel_rays(camera, 8, 6), disc)
    start, toward = (
        camera.matrix @ np.vstack([part.numpy(), np.full((1, 48), w)])
        for part, w in ((ray.o, 1.0), (ray.d, 0.0))
    )
    at = start + toward * ((-depth - start[2]) / toward[2])
    offset = at[:2] / depth - camera.rays().reshape(3, -1)[:2]
    radius = np.linalg.norm(offset, axis=0) * camera.pixels_per_unit
    assert radius == pytest.approx(abs(blur(camera, depth, 2.0, 0.3)) / 2, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize(
    ("focus", "aperture"), [(1.5, 0.45), (1.5, 0.9), (9.0, 0.9), (2.0, 1.2), (1e9, 0.6)]
)
def test_a_patch_spreads_over_the_circle(
    patch: Scene, ahead: Camera, focus: float, aperture: float
) -> None:
    """Before and behind focus it is convolved with a disc: variances add up, energy is kept."""
    value, error, pinhole = seen_through(patch, ahead, LAMP, focus=focus, aperture=aperture)
    diameter = abs(blur(ahead, DEPTH, focus, aperture))
    assert 6 < diameter < 30
    place = np.arange(48) - 23.5
    energy = value.sum()
    sigma = np.sqrt((error.astype(np.float64) ** 2).sum())
    assert abs(energy - 100 * WHITE) < 3 * sigma + 2e-3 * energy
    assert pinhole.sum() == pytest.approx(100 * WHITE, rel=1e-3)
    for axis in (0, 1):
        variance = (value.sum(axis) * place**2).sum() / energy
        assert variance == pytest.approx(100 / 12 + diameter**2 / 16, rel=0.02)
    apart = np.hypot(*np.maximum(np.abs(np.meshgrid(place, place)) - 5, 0))
    assert (value[apart > diameter / 2 + 1e-3] == 0).all()
    assert (value[apart < diameter / 2 - 1.5] > 0).all()


def test_in_focus_it_is_the_pinhole_picture(patch: Scene, ahead: Camera) -> None:
    value, error, pinhole = seen_through(patch, ahead, LAMP, focus=DEPTH, aperture=0.9)
    assert value == pytest.approx(pinhole, rel=1e-4)
    assert error.max() < 1e-4 * WHITE


@pytest.mark.parametrize(("focus", "aperture"), [(1.0, 0.0), (None, None)])
def test_a_closed_lens_is_a_pinhole(
    patch: Scene, ahead: Camera, focus: float | None, aperture: float | None
) -> None:
    value, error, pinhole = seen_through(patch, ahead, LAMP, focus=focus, aperture=aperture)
    assert value == pytest.approx(pinhole, rel=1e-5)
    assert (error < 1e-6 * WHITE).all()


def test_a_constant_stays(ahead: Camera) -> None:
    wall = Scene.from_mesh("wall", matte(quad((0, 0, -DEPTH), (50, 0, 0), (0, 50, 0))))
    value, _, _ = seen_through(wall, ahead, lit(zenith=2, horizon=2, ground=2), focus=1, aperture=1)
    assert value == pytest.approx(np.full((48, 48), 1.4), rel=1e-4)


def test_an_edge_against_the_sky_blurs_like_infinity(ahead: Camera) -> None:
    """What a disc that straddles the edge sees of the sky is a circle's segment."""
    far = matte(quad((-5e5, 0, -1e6), (5e5, 0, 0), (0, 2e6, 0)), 0.0)
    scene = Scene.from_mesh("far", far)
    light = lit(zenith=3, horizon=3, ground=3)
    value, error, _ = seen_through(scene, ahead, light, focus=2.0, aperture=0.6, samples=1024)
    diameter = blur(ahead, np.inf, 2.0, 0.6)
    t = np.clip((np.arange(48) - 23.5) / (diameter / 2), -1, 1)
    segment = 0.5 + (t * np.sqrt(1 - t * t) + np.arcsin(t)) / np.pi
    assert_within(value, error, np.broadcast_to(3 * segment, (48, 48)))


def test_its_error_is_the_spread_of_repeated_renders(patch: Scene, ahead: Camera) -> None:
    hits = trace(patch, ahead, 48, 48)
    view = View(ahead, 1.0, focus=1.5, aperture=0.9, light=lit((1, 1, 0), intensity=9, horizon=1))
    runs = [dof.reference(patch, view, hits, {}, samples=16, seed=seed) for seed in range(24)]
    spread = np.stack([value for value, _ in runs]).var(0, ddof=1).mean()
    claimed = np.stack([error**2 for _, error in runs]).mean()
    assert claimed == pytest.approx(spread, rel=0.1)
