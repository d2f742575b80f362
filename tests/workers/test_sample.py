"""Attributes and references of a view: what is asked for, from wherever it is asked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DeepshadeError, SceneError
from deepshade_workers import references
from deepshade_workers.datagen import make_sample
from deepshade_workers.dataspec import DataSpec
from deepshade_workers.render import render, render_sample
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.mesh import Object, merge
from deepshade_workers.scenes.scene import SKY_RADIANCE, Scene
from deepshade_workers.view import View

from .conftest import quad, seen

# (mean, standard deviation) of a sample before references had files of their own.
BEFORE = {
    "procedural:crockery:1": {
        "position": (-0.433246, 1.243484),
        "normal": (0.113700, 0.427911),
        "reference_ao": (0.825623, 0.259776),
        "reference_ao_error": (0.011549, 0.014638),
    },
    "procedural:room:3": {
        "position": (-0.130838, 0.252435),
        "normal": (0.157761, 0.555378),
        "reference_ao": (0.913757, 0.141577),
        "reference_ao_error": (0.008399, 0.011715),
    },
}
CLOSER = Camera.look_at((0, 0, 0), (0, 0, -1), (0, 1, 0), 60, 64, 48)


@pytest.mark.parametrize(
    ("scene", "seed"), [("procedural:crockery:1", 5), ("procedural:room:3", 2)]
)
def test_ambient_occlusion_is_what_it_was(scene: str, seed: int) -> None:
    spec = DataSpec(scenes=(scene,), views=1, size=48, frame=96, spp=64, seed=seed)
    images, _ = make_sample(spec, 0)
    assert set(images) == set(BEFORE[scene])  # and nothing else is made
    for name, figures in BEFORE[scene].items():
        found = (images[name].mean(dtype=np.float64), images[name].std(dtype=np.float64))
        assert found == pytest.approx(figures, abs=1e-6), name


def test_every_effect_of_the_table_or_a_list_of_those_there_are(tmp_path: Path) -> None:
    assert set(references.known()) <= set(EFFECTS)
    for effect in references.known():
        assert callable(references.reference_of(effect))
    scene, out = open_scene("procedural:crockery:1"), tmp_path / "a.exr"
    view = View(Camera.look_at((2, 3, 4), (0, 0.4, 0), (0, 1, 0), 50, 8, 8), 0.3)
    for effect in {*EFFECTS, "nothing"} - set(references.known()):
        with pytest.raises(ConfigError, match=f"no reference for '{effect}'; there are: aa, ao"):
            DataSpec(scenes=("procedural:room",), views=1, effects=("ao", effect))
        with pytest.raises(ConfigError, match=f"no reference for '{effect}'; there are: aa, ao"):
            render(scene, view, out, effects=["ao", effect], samples=2, seed=1)
    assert not out.exists()


@pytest.fixture
def trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An effect gets a file of its own, which answers with the light it was handed."""
    effect = next(e for e in EFFECTS if "light" in EFFECTS[e].inputs)
    (tmp_path / f"{effect}.py").write_text(
        "def reference(scene, view, hits, images, *, samples, seed):\n"
        "    return images['light'] * view.radius, 0 * images['light']\n"
    )
    # First, and imported anew, in case there is a reference; the test's end brings that back.
    monkeypatch.setattr(references, "__path__", [str(tmp_path), *references.__path__])
    module = f"{references.__name__}.{effect}"
    monkeypatch.setitem(sys.modules, module, references)
    monkeypatch.delitem(sys.modules, module)
    return effect


def test_a_file_is_all_that_an_effect_needs(trial: str, tmp_path: Path) -> None:
    """And a data set holds the same numbers as a rendered file."""
    settings = {"focus": 3.0, "aperture": 0.1} if "focal" in EFFECTS[trial].inputs else {}
    spec = DataSpec(("procedural:crockery:1",), 1, effects=("ao",), size=16, frame=16, spp=4)
    _, record = make_sample(spec, 0)
    camera = Camera(50, 16, 16, np.array(record["camera"]["world_to_camera"]))
    view = View(camera, record["radius"], **settings)
    scene, effects = open_scene(record["scene"]), ["ao", trial]
    images = render_sample(scene, view, 16, 16, effects=effects, samples=4, seed=record["seed"])
    render(
        scene,
        view,
        tmp_path / "a.exr",
        effects=effects,
        samples=4,
        seed=record["seed"],
        attributes=["light"],
    )
    found = exr.read(tmp_path / "a.exr").pixels
    assert images["light"].max() > 0
    for k, band in enumerate("RGB"):
        assert (found[f"light.{band}"] == images["light"][k]).all()
        assert (found[f"reference_{trial}.{band}"] == images["light"][k] * view.radius).all()
    assert (found["reference_ao.V"] == images["reference_ao"][0]).all()
    assert not {"position.X", "motion.U"} & set(found)


def test_light_costs_rays_only_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def traced(*_: Any, **__: Any) -> Any:
        raise AssertionError("shadow rays were traced")

    monkeypatch.setattr("deepshade_workers.attributes.direct_light", traced)
    scene = open_scene("procedural:crockery:1")
    dark = [name for name in ATTRIBUTES if name not in ("light", "light_diffuse")]
    images = seen(scene, CLOSER, *dark, focus=1.0, aperture=0.1)
    assert set(images) == set(dark)
    assert all(image.dtype == np.float32 for image in images.values())
    with pytest.raises(AssertionError, match="shadow rays"):
        seen(scene, CLOSER, "light")


def test_an_attribute_that_needs_a_setting_says_so() -> None:
    with pytest.raises(ConfigError, match="'focal' needs the field of view and the lens"):
        seen(open_scene("procedural:crockery:1"), CLOSER, "focal", focus=2.0)


def test_background_is_the_sky_at_infinity() -> None:
    camera = Camera.look_at((0.5, 1, 4), (0.4, 0, 0), (0.1, 1, 0), 50, 64, 48)
    scene = Scene.from_mesh("quad", quad((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    images = seen(scene, camera, *ATTRIBUTES, focus=2.0, aperture=0.05)
    outside = np.isinf(images["depth"][0])
    assert 0.2 < outside.mean() < 0.95
    assert np.allclose(images["light"][:, outside], SKY_RADIANCE)
    assert np.allclose(images["focal"][0, outside], 0.05 / 2.0 * camera.pixels_per_unit, rtol=1e-6)
    toward = np.linalg.inv(camera.matrix)[:3, :3] @ -camera.rays().reshape(3, -1)
    toward = (toward / np.linalg.norm(toward, axis=0)).reshape(3, 48, 64)
    assert np.abs(images["view"] - toward)[:, outside].max() < 1e-6
    for name in set(ATTRIBUTES) - {"depth", "light", "focal", "view"}:
        assert (images[name][:, outside] == 0).all(), name


def test_a_library_that_mitsuba_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small Debian has no libatomic, and Dr.Jit ends with a NameError."""
    from deepshade_workers.backend import mitsuba

    monkeypatch.setitem(sys.modules, "drjit", None)
    with pytest.raises(DeepshadeError, match=r"Mitsuba can't be loaded.*drjit") as raised:
        mitsuba.__wrapped__()
    assert "libatomic1" in raised.value.fix


def sky_map(path: Path) -> None:
    pixels = np.zeros((3, 16, 32), np.float32)
    pixels[0, :8], pixels[1, 8:] = 3.0, 70_000.0
    with path.open("wb") as file:
        exr.write(file, dict(zip("RGB", pixels, strict=True)))


@pytest.mark.slow
def test_one_thread_reads_exr_files_too(tmp_path: Path) -> None:
    """As each of datagen's processes has; Mitsuba alone would wait for ever, deaf to signals."""
    sky_map(tmp_path / "sky.exr")
    (tmp_path / "sky.xml").write_text(
        '<scene version="3.0.0"><shape type="sphere"/>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    )
    code = (
        "import sys; from deepshade_workers.backend import mitsuba; mitsuba(); import drjit\n"
        "from deepshade_workers.scenes.loading import open_scene\n"
        "drjit.set_thread_count(1); scene = open_scene(sys.argv[1])\n"
        "print(scene.name, drjit.thread_count())"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "sky.xml")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["sky", "1"], done.stderr


def test_the_sky_is_seen_where_it_is(tmp_path: Path) -> None:
    """Red above and green below an empty horizon; without a sky, nothing."""
    sky_map(tmp_path / "sky.exr")
    shape = '<shape type="sphere"><point name="center" x="9" y="9" z="9"/></shape>'
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    for name, emitter in (("sky", sky), ("dark", '<emitter type="point"/>')):
        (tmp_path / f"{name}.xml").write_text(f'<scene version="3.0.0">{shape}{emitter}</scene>')
    light = seen(open_scene(str(tmp_path / "sky.xml")), CLOSER, "light")["light"]
    assert np.allclose(light[:, :16].mean((1, 2)), (3, 0, 0), atol=1e-3)
    assert np.allclose(light[:, 32:].mean((1, 2)), (0, 70_000, 0), rtol=1e-3)
    assert (seen(open_scene(str(tmp_path / "dark.xml")), CLOSER, "light")["light"] == 0).all()


@pytest.fixture(scope="module")
def planes() -> Scene:
    """Two upright squares, left at distance 2 and right at distance 4, and nothing behind."""
    left, right = (
        quad((-1, 0, -2), (0.9, 0, 0), (0, 0.8, 0)),
        quad((2, 0, -4), (1, 0, 0), (0, 1, 0)),
    )
    return Scene.from_mesh("planes", merge([left, right], ["left", "right"]))


def test_a_plane_parallel_to_the_image_moves_by_its_distance_over_depth(planes: Scene) -> None:
    assert planes.objects == (Object("left", 0, 2), Object("right", 2, 4))
    moves = {"left": (0.3, 0.1, 0.0), "right": (-0.2, 0.4, 0.0)}
    images = seen(planes, CLOSER, "motion", "depth", displacements=moves)
    for depth, (dx, dy, _) in ((2, moves["left"]), (4, moves["right"])):
        on = np.isclose(images["depth"][0], depth)
        assert on.sum() > 100
        scale = CLOSER.pixels_per_unit / depth
        assert np.allclose(images["motion"][:, on].T, (dx * scale, -dy * scale), atol=1e-4)
    assert (images["motion"][:, np.isinf(images["depth"][0])] == 0).all()


def test_motion_towards_the_camera_is_what_two_projections_say(planes: Scene) -> None:
    """And stays finite where the object moves through the camera."""
    images = seen(planes, CLOSER, "motion", "position", displacements={"left": (0.1, 0, 1.0)})
    on = np.isclose(images["position"][2], -2)
    x, y, _ = images["position"][:, on].astype(np.float64)
    u = ((x + 0.05) / 1.5 - (x - 0.05) / 2.5) * CLOSER.pixels_per_unit
    v = -(y / 1.5 - y / 2.5) * CLOSER.pixels_per_unit
    assert np.allclose(images["motion"][:, on], (u, v), atol=1e-4)
    assert (images["motion"][:, ~on] == 0).all()
    through = seen(planes, CLOSER, "motion", displacements={"left": (0, 0, 9.0)})["motion"]
    assert np.isfinite(through).all()


def test_only_objects_of_the_scene_move(planes: Scene) -> None:
    with pytest.raises(SceneError, match="no object 'lefd'") as caught:
        seen(planes, CLOSER, "motion", displacements={"lefd": (1, 0, 0)})
    assert "'left'" in caught.value.fix


def test_a_moved_sample_is_recorded() -> None:
    spec = DataSpec(("procedural:crockery:1",), 1, size=16, frame=16, spp=2)
    still, plain = make_sample(spec, 0)
    moved, record = make_sample(spec, 0, displacements={"object 2": (0.1, 0, 0)})
    assert record == {**plain, "displacements": {"object 2": [0.1, 0, 0]}}
    assert (still["reference_ao"] == moved["reference_ao"]).all()
