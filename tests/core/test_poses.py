"""Where a camera stands, from world-space positions, against the camera that saw them."""

from __future__ import annotations

import numpy as np
import pytest
from tests.core.test_checks import CAMERA, NEEDS, SLANT, H, N, P, W, Z, encode

from deepshade.camera import Camera
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.poses import rigid

VIEW = Camera.look_at((3, 2, 5), (0.2, 0.1, 0), (0, 1, 0), CAMERA.fov, W, H)


def placed(mirror):
    """World-space positions and normals; a left-handed world has z the other way."""
    inverse = np.diag([1, 1, mirror, 1]) @ np.linalg.inv(VIEW.matrix)
    points = np.tensordot(inverse[:3, :3], P, 1) + inverse[:3, 3, None, None]
    return points, np.tensordot(inverse[:3, :3], N, 1), np.linalg.inv(inverse)


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("beside", [{"Z": Z}, {"distance": Z * SLANT}], ids=["depth", "distance"])
def test_the_matrix_is_found(mirror, beside):
    points, normals, matrix = placed(mirror)
    gbuffer = load_gbuffer(encode(position_world=points, normal_world=normals, **beside), NEEDS)
    assert "worldToCamera from world-space positions" in gbuffer.derived["normal"]
    np.testing.assert_allclose(gbuffer.attributes["normal"], N, atol=1e-4)
    np.testing.assert_allclose(gbuffer.attributes["position"], P, atol=1e-4)
    assert gbuffer.camera
    np.testing.assert_allclose(gbuffer.camera.matrix, matrix, atol=1e-5)


def test_points_that_do_not_fit_tell_nothing():
    points, normals, _ = placed(1)
    noise = np.random.default_rng(0).uniform(1, 9, Z.shape).astype(np.float32)
    body = encode(position_world=points, normal_world=normals, Z=noise)
    derived = load_gbuffer(body, ("position",)).derived
    assert "worldToCamera from" not in derived["position"]


def test_outliers_do_not_count():
    rng = np.random.default_rng(1)
    world = rng.normal(size=(3, 400))
    seen = VIEW.matrix[:3, :3] @ world + VIEW.matrix[:3, 3:]
    seen[:, ::10] += rng.normal(size=(3, 40))
    found = rigid(world, seen)
    assert found is not None
    np.testing.assert_allclose(found, VIEW.matrix, atol=1e-9)
    assert rigid(world[:, :20], seen[:, :20]) is None
