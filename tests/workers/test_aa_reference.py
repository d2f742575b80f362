"""Anti-aliasing, against the area that an edge covers of each pixel."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers.lighting import direct_light
from deepshade_workers.references import aa
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import View

from .conftest import assert_within, lit, matte, quad

SIZE = 32


def half_plane(angle: float, shift: float, camera: Camera, diffuse: float) -> Scene:
    """A large surface that ends at a line: `shift` pixels from the middle along the normal."""
    across = np.array([np.cos(angle), np.sin(angle), 0]) * 50
    along = np.array([-np.sin(angle), np.cos(angle), 0]) * 50
    edge = across / 50 * shift * 2 / camera.pixels_per_unit
    return Scene.from_mesh(
        "half", matte(quad(edge - across + np.array([0, 0, -2]), across, along), diffuse)
    )


def covered(angle: float, shift: float) -> np.ndarray:
    """Exact area of each pixel within the half plane, (SIZE, SIZE).

    With a, b the normal's positive parts and s the way from a pixel's deepest corner to the line,
    the unit square before the line has (s₊² - (s-a)₊² - (s-b)₊² + (s-a-b)₊²) / 2ab.
    """
    x = np.arange(SIZE) + 0.5 - SIZE / 2
    y = SIZE / 2 - 0.5 - np.arange(SIZE)
    a, b = abs(np.cos(angle)), abs(np.sin(angle))
    s = shift - (np.cos(angle) * x + np.sin(angle) * y[:, None]) + (a + b) / 2
    square = sum(
        sign * np.maximum(s - part, 0) ** 2 for part, sign in ((0, 1), (a, -1), (b, -1), (a + b, 1))
    )
    return np.asarray(square / (2 * a * b))


@pytest.fixture(scope="module")
def ahead() -> Camera:
    return Camera.look_at((0, 0, 0), (0, 0, -1), (0, 1, 0), 30, SIZE, SIZE)


def smoothed(scene: Scene, camera: Camera, light: Any, *, samples: int = 256) -> Any:
    """(H, W) value and error of one channel."""
    hits = trace(scene, camera, SIZE, SIZE)
    view = View(camera, 1.0, light=light)
    value, error = aa.reference(scene, view, hits, {}, samples=samples, seed=1)
    return value[2], error[2]


@pytest.mark.parametrize(("angle", "shift"), [(0.4, 0.3), (1.5, -3.2), (2.5, 5.1), (-2.0, 0.0)])
def test_coverage_of_a_slanted_edge_is_its_area(ahead: Camera, angle: float, shift: float) -> None:
    scene = half_plane(angle, shift, ahead, 0.7)
    value, error = smoothed(scene, ahead, lit((0, 0, 1e4), intensity=10002.0**2))
    expected = 0.7 / np.pi * covered(angle, shift)
    assert_within(value, error, expected)
    assert ((value > 0) & (value < 0.999 * value.max())).sum() > SIZE / 2


def test_silhouettes_against_the_sky_are_smoothed(ahead: Camera) -> None:
    scene = half_plane(0.4, 0.3, ahead, 0.0)
    value, error = smoothed(scene, ahead, lit(zenith=5, horizon=5, ground=5))
    assert_within(value, error, 5 * (1 - covered(0.4, 0.3)))


def test_a_flat_surface_has_no_error_and_stays(ahead: Camera) -> None:
    scene = half_plane(0.4, 500.0, ahead, 0.7)
    light = lit((0, 0, 1e4), intensity=10002.0**2)
    value, error = smoothed(scene, ahead, light)
    hits = trace(scene, ahead, SIZE, SIZE)
    pinhole, _ = direct_light(scene, View(ahead, 1.0, light=light), hits, samples=2, seed=1)
    assert value == pytest.approx(pinhole[2], rel=1e-4)
    assert error.max() < 1e-5


def test_it_takes_64_samples_at_least(ahead: Camera) -> None:
    scene = half_plane(0.4, 0.3, ahead, 0.7)
    light = lit((0, 0, 1e4), intensity=10002.0**2)
    few, _ = smoothed(scene, ahead, light, samples=2)
    enough, _ = smoothed(scene, ahead, light, samples=64)
    assert (few == enough).all()
