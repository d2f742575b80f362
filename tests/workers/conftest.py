"""Small scenes with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera


def quad(center: Any, u: Any, v: Any) -> Any:
    """A parallelogram center ± u ± v, facing u x v."""
    from deepshade_workers.scenes.mesh import Mesh

    c, u, v = (np.array(x, np.float64) for x in (center, u, v))
    corners = np.stack([c - u - v, c + u - v, c + u + v, c - u + v])
    return Mesh.build(corners, np.array([[0, 1, 2], [0, 2, 3]]), crease=0)


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
