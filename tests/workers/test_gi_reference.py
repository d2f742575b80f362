"""Indirect light, against form factors of rectangles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers.references import gi
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import View

from .conftest import assert_within, lit, matte, quad

FAR = 1e4
BRIGHT = 0.7 / np.pi * np.sqrt(0.5)  # a matte surface that the lamp below hits at 45°
CEILING = ((0, 1, 0), (0.4, 0, 0), (0, 0, -0.3))
WALL = ((0.5, 0.55, 0), (0, 0.5, 0), (0, 0, 0.4))


def far_lamp(x: float, y: float, z: float, strength: float = 1.0) -> Any:
    """So far that it lights alike everywhere: irradiance `strength` on what faces it."""
    direction = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    return lit(direction * FAR, intensity=strength * FAR**2)


BELOW, ASIDE = (1, -1, 0), (-1, 1, 0)


def gathered(patch: Any, light: Any, *, radius: float = 5.0, seed: int = 1) -> Any:
    """(N,) value and error on a small floor that sees `patch`, and the hits' positions."""
    floor = matte(quad((0, 0, 0), (0.1, 0, 0), (0, 0, -0.1)))
    scene = Scene.from_mesh("two", merge([floor, matte(quad(*patch))]))
    camera = Camera.look_at((0, 0.5, 0), (0, 0, 0), (0, 0, -1), 20, 16, 16)
    hits = trace(scene, camera, 16, 16)
    view = View(camera, radius, light=light)
    value, error = gi.reference(scene, view, hits, {}, samples=256, seed=seed)
    return value[0].ravel(), error[0].ravel(), hits.p.numpy().T


def form_factor(patch: Any, point: np.ndarray) -> float:
    """From a point of the floor to a rectangle above it (Lambert's formula for polygons)."""
    c, u, v = (np.array(x, np.float64) for x in patch)
    corners = [c - u - v, c + u - v, c + u + v, c - u + v]
    total = 0.0
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        a, b = a - point, b - point
        normal = np.cross(a, b)
        angle = np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        total += angle * normal[1] / np.linalg.norm(normal)
    return abs(total) / (2 * np.pi)


@pytest.mark.parametrize("side", [1, -1])  # a surface reflects on both of its faces
@pytest.mark.parametrize(("patch", "lamp"), [(CEILING, BELOW), (WALL, ASIDE)])
def test_rectangles_exchange_what_their_form_factor_says(patch: Any, lamp: Any, side: int) -> None:
    center, u, v = patch
    turned = (center, u, tuple(side * x for x in v))
    value, error, points = gathered(turned, far_lamp(*lamp))
    expected = BRIGHT * np.array([form_factor(patch, p) for p in points])
    assert expected.min() > 0.01
    assert_within(value, error, expected)


def test_a_corner_has_howells_form_factor() -> None:
    """B-3 of Howell's catalogue checks the formula above: a parallel rectangle's corner."""
    a = b = 1.0
    root = np.sqrt(2.0)
    howell = (a / root * np.arctan(b / root) + b / root * np.arctan(a / root)) / (2 * np.pi)
    patch = ((0.5, 1, 0.5), (0.5, 0, 0), (0, 0, 0.5))
    assert form_factor(patch, np.zeros(3)) == pytest.approx(howell)


def test_it_is_linear_in_the_light() -> None:
    once, error, _ = gathered(CEILING, far_lamp(*BELOW))
    twice, wider, _ = gathered(CEILING, far_lamp(*BELOW, strength=2.0))
    assert twice == pytest.approx(2 * once, rel=1e-6)
    assert wider == pytest.approx(2 * error, rel=1e-6)


def test_it_is_dark_without_light() -> None:
    value, error, _ = gathered(CEILING, lit())
    assert (value == 0).all()
    assert (error == 0).all()


def test_a_shadowed_surface_sends_nothing() -> None:
    value, _, _ = gathered(CEILING, far_lamp(-1, 1, 0))  # lights the other face
    assert (value == 0).all()


def test_nothing_beyond_the_radius_counts() -> None:
    assert (gathered(CEILING, far_lamp(*BELOW), radius=0.99)[0] == 0).all()
    near, _, _ = gathered(CEILING, far_lamp(*BELOW), radius=1.05)
    whole, _, _ = gathered(CEILING, far_lamp(*BELOW))
    assert (near > 0).all()
    assert near.mean() < 0.9 * whole.mean()


def test_background_is_black() -> None:
    scene = Scene.from_mesh("quad", quad((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), (0, 1, 0), 50, 16, 16)
    hits = trace(scene, camera, 16, 16)
    view = View(camera, 1.0, light=lit(zenith=1, horizon=1, ground=1))
    value, error = gi.reference(scene, view, hits, {}, samples=16, seed=1)
    assert (value == 0).all()
    assert (error == 0).all()
