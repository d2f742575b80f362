"""Light, lens and motions that views draw: within what was asked for, and in the open."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deepshade.errors import ConfigError, SceneError
from deepshade_workers import references
from deepshade_workers.attributes import make_attributes
from deepshade_workers.datagen import make_sample, make_shard
from deepshade_workers.dataspec import DataSpec, expand_scenes
from deepshade_workers.records import record_of, view_of
from deepshade_workers.render import render_sample
from deepshade_workers.scenes.composition import compose
from deepshade_workers.scenes.loading import is_unseeded, load_mesh, open_scene
from deepshade_workers.trace import trace
from deepshade_workers.view import Limits, View
from deepshade_workers.viewpoints import sample_view

SCENE = "procedural:crockery:1"
SPECS = {name: DataSpec((SCENE,), 1, effects=(name,)) for name in references.known()}
# Environments lie beside a data set: test_datagen has their records.
LIGHT_EFFECTS = tuple(name for name, spec in SPECS.items() if spec.limits and not spec.surrounded)


def drawn(seed: int, limits: Limits | None = None) -> View:
    rng = np.random.default_rng(seed)
    return sample_view(open_scene(SCENE), rng, frame=96, size=64, limits=limits or Limits())


def test_what_is_drawn_beside_the_camera_does_not_change_it() -> None:
    bare = sample_view(open_scene(SCENE), np.random.default_rng(5), frame=96, size=64)
    full = drawn(5)
    assert (bare.camera.matrix == full.camera.matrix).all()
    assert bare.radius == full.radius
    assert bare == replace(
        full, focus=None, aperture=None, shutter=None, displacements={}, light=None
    )
    assert full == drawn(5)


@pytest.mark.slow
def test_blur_and_motion_stay_within_their_limits() -> None:
    limits = Limits(max_blur=16, max_motion=24)
    scene = open_scene(SCENE)
    blurs, motions = [], []
    for seed in range(12):
        view = drawn(seed, limits)
        hits = trace(scene, view.camera, 64, 64)
        images = make_attributes(scene, view, hits, ("focal", "motion"), seed=1)
        blurs.append(np.percentile(np.abs(images["focal"]), 95))
        motions.append(np.percentile(np.hypot(*images["motion"]), 95))
        camera = view.camera
        for by in view.displacements.values():  # parallel to the image plane
            assert abs(camera.matrix[2, :3] @ by) < 1e-6 * np.linalg.norm(by)
    # A coarse picture's percentile is not quite the picture's own.
    assert max(blurs) < 16 * 1.25
    assert max(motions) < 24 * 1.25
    assert max(blurs) > 6
    assert max(motions) > 6
    assert np.count_nonzero(motions) > 8


def test_lamps_are_in_the_open_and_light_something() -> None:
    scene = open_scene("procedural:room:3")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        view = sample_view(scene, rng, frame=64, size=64, limits=Limits())
        assert view.light is not None
        dark = replace(view.light, zenith=(0, 0, 0), horizon=(0, 0, 0), ground=(0, 0, 0))
        hits = trace(scene, view.camera, 64, 64)
        lit = make_attributes(scene, replace(view, light=dark), hits, ["light_diffuse"], seed=1)
        assert (lit["light_diffuse"].sum(0) > 0).mean() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_view_of_light_is_rendered_again_from_its_record(seed: int) -> None:
    spec = DataSpec((SCENE,), 1, effects=LIGHT_EFFECTS, size=16, frame=32, spp=4, seed=seed)
    images, record = make_sample(spec, 0)
    record = json.loads(json.dumps(record))
    scene = open_scene(record["scene"])
    view = view_of(record, scene)
    assert record_of(view).items() <= record.items()
    again = render_sample(
        scene, view, 16, 16, effects=LIGHT_EFFECTS, samples=4, seed=record["seed"]
    )
    for name, image in images.items():
        assert (again[name] == image).all(), name


def test_a_set_of_occlusion_pays_for_nothing_it_does_not_show(tmp_path: Path) -> None:
    spec = DataSpec((SCENE,), 1, size=16, frame=32, spp=4)
    assert spec.limits is None
    shard = make_shard(spec, 0, tmp_path, lambda: None)
    assert not {"light", "look", "focus"} & set(shard.samples[0])
    assert LIGHT_EFFECTS


@pytest.mark.parametrize("change", [{"max_blur": 0.0}, {"max_motion": -1.0}, {"effects": ()}])
def test_impossible_ranges_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        DataSpec(**{"scenes": (SCENE,), "views": 1, **change})  # type: ignore[arg-type]


def test_mesh_files_are_composed_to_scenes(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 3 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\n")
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 90 0 0\nv 0 30 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\n")
    name = f"compose:{tmp_path}"
    assert expand_scenes([name]) == (name,)
    assert is_unseeded(name)
    assert not is_unseeded(f"{name}:3")
    scene = open_scene(f"{name}:3")
    kinds = {item.name.split()[0] for item in scene.objects}
    assert {"a", "b", "floor"} <= kinds
    assert len({item.name for item in scene.objects}) == len(scene.objects) >= 9
    files = tuple(sorted(tmp_path.glob("*.obj")))
    one, same, other = (compose("x", files, load_mesh, seed) for seed in (3, 3, 4))
    assert (one.vertices == same.vertices).all()
    assert one.vertices.shape != other.vertices.shape or (one.vertices != other.vertices).any()
    sizes = [
        np.ptp(one.vertices[one.faces[o.start : o.stop]].reshape(-1, 3), 0).max()
        for o in one.objects
        if o.name[0] in "ab"
    ]
    assert max(sizes) < 6 * min(sizes)  # one file's units are thirty times the other's
    for wrong in (f"compose:{tmp_path}/none", "compose:", f"{name}+nothing.obj:1"):
        with pytest.raises(SceneError):
            open_scene(wrong)
