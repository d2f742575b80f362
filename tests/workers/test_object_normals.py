"""Object-space normals, and the samples of pixels that a perceptron learns from."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade import circles as places
from deepshade.camera import Camera
from deepshade.errors import ConfigError
from deepshade_workers.circles import render_circles, view_around
from deepshade_workers.datagen import make_sample
from deepshade_workers.dataspec import DataSpec
from deepshade_workers.render import render_sample
from deepshade_workers.scenes.mesh import Mesh, merge
from deepshade_workers.scenes.procedural import FAMILIES
from deepshade_workers.scenes.procedural.primitives import box, place, turn_y
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.shards import circle_schema, write_shard
from deepshade_workers.view import View


def seen(mesh: Mesh, eye=(1.0, 2.0, 4.0), size=48):
    scene = Scene.from_mesh("made", mesh)
    view = View(Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 50, size, size), 0.5)
    names = ["normal_object", "normal_world"]
    return render_sample(scene, view, size, size, effects=[], attributes=names, samples=2, seed=0)


def test_what_was_never_moved_has_the_worlds_normals():
    images = seen(merge([box()], ["box"]))
    assert np.allclose(images["normal_object"], images["normal_world"], atol=1e-6)


def test_a_turned_and_stretched_object_keeps_the_normals_of_its_own_frame():
    matrix = place((0.2, 0, 0), (1, 2, 0.5), turn_y(0.7))
    images = seen(merge([box().transformed(matrix)], ["box"], [matrix]))
    own = images["normal_object"].reshape(3, -1).T
    own = own[np.linalg.norm(own, axis=1) > 0]
    assert len(own) > 100
    # a box's faces look along its own axes, whatever was done to it
    assert np.allclose(np.sort(np.abs(own), 1), [0, 0, 1], atol=1e-5)
    assert not np.allclose(images["normal_object"], images["normal_world"], atol=0.1)


def test_samples_are_the_normals_around_pixels_of_the_view_and_its_reference():
    scene = Scene.from_mesh("made", merge([box()], ["box"]))
    view = view_around(scene, 3, 0, 64, None)
    whole = render_sample(
        scene, view, 64, 64, effects=["ao"], attributes=["normal_object"], samples=64, seed=1
    )
    few = render_circles(scene, view, 64, 200, effects=["ao"], samples=64, seed=1)
    normals, answers = few["normal_object"], few["reference_ao"]
    assert normals.shape == (3, places.POINTS, 200) and answers.shape == (1, 1, 200)
    wide = np.pad(whole["normal_object"], ((0, 0), (10, 10), (10, 10)))
    around = np.stack(  # (3, 16, H, W)
        [wide[:, 10 + y : 74 + y, 10 + x : 74 + x] for x, y in places.offsets()], 1
    ).reshape(48, -1)
    for sample in range(0, 200, 20):
        same = np.flatnonzero((around == normals[:, :, sample].reshape(48, 1)).all(0))
        assert len(same)
        near = np.abs(whole["reference_ao"].ravel()[same] - answers[0, 0, sample])
        assert near.min() < 0.15  # other random numbers


def test_the_whole_is_seen_from_a_sphere_evenly():
    scene = Scene.from_mesh("made", merge([box()], ["box"]))
    eyes = np.array([view_around(scene, k, 5, 64, None).camera.eye for k in range(128)])
    eyes = (eyes - scene.bounds.mean(0)) / scene.diagonal
    assert np.allclose(np.linalg.norm(eyes, axis=1), np.linalg.norm(eyes[0]))
    assert np.linalg.norm(eyes.mean(0)) < 0.1


def test_shards_hold_numbers_in_the_order_of_their_shapes(tmp_path):
    """NumPy keeps the order of what it stacks, and safetensors writes memory as it lies."""
    from safetensors.numpy import load_file

    turned = np.arange(3 * 16 * 5, dtype=np.float32).reshape(5, 16, 3).T / 256
    images = {
        "normal_object": turned,
        "reference_ao": np.zeros((1, 1, 5), np.float32),
        "reference_ao_error": np.zeros((1, 1, 5), np.float32),
    }
    shard = write_shard(tmp_path, 0, circle_schema(["ao"], 5), [images, images], [{}, {}])
    found = load_file(tmp_path / shard.file)["normal_object"]
    assert (found == turned.astype(np.float16)).all()


def test_pixels_are_of_one_mesh_and_of_geometry():
    with pytest.raises(ConfigError, match="geometry alone"):
        DataSpec(("a.obj",), 4, effects=("gi",), pixels=16)
    with pytest.raises(ConfigError, match="exclude each other"):
        DataSpec(("a.obj",), 4, pixels=16, attributes=("normal_object",))
    with pytest.raises(ConfigError, match="is many"):
        make_sample(DataSpec(("procedural:" + next(iter(FAMILIES)),), 4, pixels=16), 0)
