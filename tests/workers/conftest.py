"""Small scenes with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera


def quad(center: Any, u: Any, v: Any, **terms: Any) -> Any:
    """A parallelogram center ± u ± v, facing u x v, of a material of these `terms`."""
    from deepshade_workers.scenes.mesh import Material, Mesh

    c, u, v = (np.array(x, np.float64) for x in (center, u, v))
    corners = np.stack([c - u - v, c + u - v, c + u + v, c - u + v])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh.build(corners, faces, crease=0, material=Material(**terms))


def seen(scene: Any, camera: Camera, *names: str, **settings: Any) -> Any:
    """Attributes `names` of the camera's whole frame, 64 x 48 at most."""
    from deepshade_workers.attributes import make_attributes
    from deepshade_workers.trace import trace
    from deepshade_workers.view import View

    view = View(camera, radius=1.0, **settings)
    hits = trace(scene, camera, min(camera.width, 64), min(camera.height, 48))
    return make_attributes(scene, view, hits, names, seed=1)


@pytest.fixture(scope="session")
def down() -> Camera:
    """Looks straight down from height 2, 32² pixels."""
    return Camera.look_at((0, 2, 0), (0, 0, 0), (0, 0, -1), 50, 32, 32)


@pytest.fixture(scope="session")
def corner() -> Any:
    """A floor at y = 0 that meets a wall at z = -1, both very large."""
    from deepshade_workers.scenes.mesh import merge
    from deepshade_workers.scenes.scene import Scene

    floor = quad((0, 0, 0), (500, 0, 0), (0, 0, -500))
    wall = quad((0, 0, -1), (500, 0, 0), (0, 500, 0))
    return Scene.from_mesh("corner", merge([floor, wall]))


def matte(mesh: Any, diffuse: float = 0.7) -> Any:
    """The mesh with that diffuse reflectance and no highlight."""
    mesh.materials[:, :3], mesh.materials[:, 3:6] = diffuse, 0
    return mesh


def lit(
    position: Any = (0, 0, 0),
    *,
    intensity: float = 0.0,
    size: float = 0.0,
    zenith: float = 0.0,
    horizon: float = 0.0,
    ground: float = 0.0,
) -> Any:
    """A grey view light; all of it is dark unless said."""
    from deepshade_workers.view import Light

    x, y, z = position
    return Light((x, y, z), size, (intensity,) * 3, (zenith,) * 3, (horizon,) * 3, (ground,) * 3)


def assert_within(value: Any, error: Any, expected: Any) -> None:
    """The mean residual lies within 3 standard errors, and few single ones don't."""
    residual = np.asarray(value, np.float64) - expected
    sigma = np.sqrt((np.asarray(error, np.float64) ** 2).sum()) / residual.size
    tiny = 1e-5 * np.abs(expected).max()
    assert abs(residual.mean()) <= 3 * sigma + tiny
    assert (np.abs(residual) > 4 * error + 0.02 * np.abs(expected).max()).mean() < 0.01
