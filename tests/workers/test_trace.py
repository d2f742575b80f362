"""Primary hits and attributes, against analytic surfaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.gbuffer.derivation import normals_from_positions
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace

from .conftest import quad, seen

SPHERE = """<scene version="3.0.0">
  <shape type="sphere"><point name="center" x="0.3" y="0.2" z="-0.1"/>
    <float name="radius" value="0.8"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></shape>
  <emitter type="point"><point name="position" x="0" y="5" z="5"/></emitter>
</scene>"""


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: Any) -> Any:
    path = tmp_path_factory.mktemp("xml") / "sphere.xml"
    path.write_text(SPHERE)
    return open_scene(str(path))


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera.look_at((1, 1.5, 3), (0.2, 0.2, 0), (0, 1, 0), 40, 64, 48)


def test_a_sphere_is_where_the_quadratic_says(sphere: Any, camera: Camera) -> None:
    images = seen(sphere, camera, "position", "normal", "depth", "diffuse")
    world = np.linalg.inv(camera.matrix)
    center = (camera.matrix @ [0.3, 0.2, -0.1, 1])[:3]
    rays = camera.rays(64, 48).reshape(3, -1).astype(np.float64)
    rays /= np.linalg.norm(rays, axis=0)
    half_b = center @ rays
    inside = half_b**2 - (center @ center - 0.8**2)
    hit = (inside > 1e-3).reshape(48, 64)
    distance = half_b - np.sqrt(np.maximum(inside, 0))
    expected = (rays * distance).reshape(3, 48, 64)
    assert np.abs(images["position"] - expected)[:, hit].max() < 2e-5
    normal = (expected - center[:, None, None]) / 0.8
    assert np.abs(images["normal"] - normal)[:, hit].max() < 2e-4
    assert np.allclose(images["depth"][0][hit], -expected[2][hit], atol=2e-5)
    assert np.allclose(images["diffuse"][:, hit].T, [0.2, 0.4, 0.6], atol=1e-5)
    assert world.shape == (4, 4)


def test_background_holds_zero_and_infinite_depth(sphere: Any, camera: Camera) -> None:
    images = seen(sphere, camera, "position", "normal", "depth", "diffuse")
    outside = np.isinf(images["depth"][0])
    assert 0.2 < outside.mean() < 0.9
    for name in ("position", "normal", "diffuse"):
        assert (images[name][:, outside] == 0).all()


def test_a_window_is_a_cut_from_the_whole_frame(corner: Any) -> None:
    whole = Camera.look_at((0, 2, 0), (0, 0, -0.5), (0, 1, 0), 50, 64, 48)
    part = Camera(50, 64, 48, whole.matrix, x0=20, y0=8)
    full = seen(corner, whole, "position", "normal")
    cut = seen(corner, part, "position", "normal")
    for name in ("position", "normal"):
        assert np.allclose(full[name][:, 8:, 20:], cut[name][:, :-8, :-20], atol=1e-5)


def test_normals_face_the_camera_on_both_sides() -> None:
    scene = Scene.from_mesh("sheet", quad((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    for z in (2.0, -2.0):
        view = Camera.look_at((0.1, 0.2, z), (0, 0, 0), (0, 1, 0), 30, 8, 8)
        hits = trace(scene, view, 8, 8)
        assert seen(scene, view, "normal")["normal"][2].min() > 0.9
        assert bool(hits.back.numpy().any()) == (z < 0)


def test_normals_agree_with_positions_on_flat_faces() -> None:
    scene = open_scene("procedural:machines:3")
    view = Camera.look_at((2, 5, 3), (0, 0, 0), (0, 1, 0), 50, 64, 48)
    images = seen(scene, view, "position", "normal", "depth")
    valid = np.isfinite(images["depth"][0])
    derived = normals_from_positions(images["position"], valid)
    agree = (derived * images["normal"]).sum(0)[valid]
    assert np.median(agree) > 0.999


def test_scene_files_of_the_project(shared: Path) -> None:
    scene = open_scene(str(shared / "scenes/spot/spot_triangulated.obj"))
    view = Camera.look_at((0, 0.3, -3), (0, 0.1, 0), (0, 1, 0), 50, 64, 64)
    hits = trace(scene, view, 64, 64)
    assert 0.05 < hits.valid.numpy().mean() < 0.9
    assert hits.back.numpy().mean() < 0.01
