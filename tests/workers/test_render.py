"""`deepshade render`: files that the rest of the system, and other programs, can read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.cli import main
from deepshade.environments import sky
from deepshade.gbuffer import load_gbuffer
from deepshade_workers.scenes.scene import SKY_RADIANCE, SUN_DIRECTION, SUN_IRRADIANCE, Scene

VIEW = ["--eye", "2", "3", "4", "--target", "0", "0.4", "0", "--size", "48x32"]
SCENE = "procedural:crockery:1"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: Any) -> Path:
    path = tmp_path_factory.mktemp("render") / "out.exr"
    options = ["--radius", "0.3", "--spp", "32", "--aperture", "0.1", "--seed", "3"]
    assert main(["render", SCENE, "-o", str(path), *VIEW, *options]) == 0
    return path


def test_every_canonical_attribute_and_the_reference_are_there(rendered: Path) -> None:
    found = exr.read(rendered)
    for attribute in ATTRIBUTES.values():
        for channel in attribute.channels:
            assert found.pixels[channel].shape == (32, 48)
            if channel != "Z":
                assert np.isfinite(found.pixels[channel]).all()
    header = found.header.parts[0].attributes
    assert header["deepshade:radius"] == pytest.approx(0.3)
    assert header["deepshade:scene"] == SCENE
    assert header["deepshade:fov"] == pytest.approx(50)
    value = found.pixels["reference_ao.V"]
    assert value.min() >= 0
    assert value.max() <= 1
    assert (found.pixels["reference_ao_error.V"] < 0.1).all()


def test_what_core_derives_is_what_the_renderer_wrote(rendered: Path, tmp_path: Path) -> None:
    """Positions from Z, camera-space normals from world-space ones: the other way round."""
    whole = exr.read(rendered)
    names = ("position", "normal", "view", "view_angle", "focal")
    written = load_gbuffer(rendered, names)
    kept = ["Z", *ATTRIBUTES["normal_world"].channels]
    header = whole.header.parts[0].attributes
    wanted = ("worldToCamera", "deepshade:fov", "deepshade:focus", "deepshade:aperture")
    exr.write(
        tmp_path / "few.exr",
        {name: whole.pixels[name] for name in kept},
        attributes={key: header[key] for key in wanted},
    )
    derived = load_gbuffer(tmp_path / "few.exr", names)
    assert set(derived.derived) == set(names)
    for name in names:
        close = 3e-3 if name != "position" else 1e-5  # the others are stored with 16 bits
        assert np.abs(derived.attributes[name] - written.attributes[name]).max() < close, name


def test_the_sun_lights_what_faces_it(tmp_path: Path) -> None:
    """An open floor under the default lights: sun, sky and lamp, all known in closed form."""
    from deepshade.camera import Camera
    from deepshade_workers.lighting import LAMP, direct_light
    from deepshade_workers.trace import trace
    from deepshade_workers.view import View

    from .conftest import quad

    scene = Scene.from_mesh("floor", quad((0, 0, 0), (9, 0, 0), (0, 0, -9)))
    camera = Camera.look_at((0, 3, 0), (0, 0, 0), (0, 0, -1), 8, 16, 16)
    hits = trace(scene, camera, 16, 16)
    _, diffuse = direct_light(scene, View(camera, 1.0), hits, samples=4096, seed=1)
    sun = np.array(SUN_DIRECTION) / np.linalg.norm(SUN_DIRECTION)
    irradiance = SUN_IRRADIANCE * -sun[1] + np.pi * SKY_RADIANCE + LAMP
    assert diffuse.mean() == pytest.approx(0.7 / np.pi * irradiance, rel=0.02)


def test_an_environment_is_named_in_the_header(tmp_path: Path) -> None:
    """The same file again under the map that a data set would keep: found by its hash."""
    made = sky(height=16)
    path = tmp_path / "dusk.exr"
    exr.write(path, dict(zip("RGB", made.radiance, strict=True)))
    options = ["--spp", "32", "--aperture", "0.1", "--environment", str(path), "--rotate", "30"]
    options += ["--effects", "do,ibl,full"]
    assert main(["render", SCENE, "-o", str(tmp_path / "a.exr"), *VIEW, *options]) == 0
    found = exr.read(tmp_path / "a.exr")
    header = found.header.parts[0].attributes
    assert header["deepshade:environment"] == "dusk"
    assert header["deepshade:rotate"] == 30
    assert header["deepshade:environment_sha256"] == made.sha256
    for effect in ("do", "ibl", "full"):
        planes = [found.pixels[f"reference_{effect}.{letter}"] for letter in "RGB"]
        assert np.isfinite(planes).all()
        assert np.min(planes) >= 0
        assert np.std(planes) > 0.05


def test_only_the_attributes_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "few.exr"
    options = ["--spp", "2", "--attributes", "normal,depth", "--json"]
    assert main(["render", SCENE, "-o", str(path), *VIEW, *options]) == 0
    names = set(exr.read(path).pixels)
    assert names == {"Z", "normal.X", "normal.Y", "normal.Z"} | {
        "reference_ao.V",
        "reference_ao_error.V",
    }


def test_json_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["render", SCENE, "-o", str(tmp_path / "a.exr"), *VIEW, "--spp", "4", "--json"])
    figures = json.loads(capsys.readouterr().out)
    assert figures["size"] == [48, 32]
    assert 0 < figures["ao"]["mean"] <= 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--size", "0x5"], "--size"),
        (["--size", "big"], "--size"),
        (["--effects", "aoo"], "ao"),
        (["--effects", "ibl"], "ibl needs an environment map: --environment FILE"),
        (["--environment", "nothing.hdr"], "nothing.hdr"),
        (["--environment", "sky", "--rotate", "inf"], "rotate"),
        (["--radius", "-1"], "radius"),
        (["--radius", "nan"], "radius"),
        (["--fov", "180"], "field of view"),
        (["--attributes", "normals"], "normals"),
        (["--target", "2", "3", "4"], "different"),
    ],
)
def test_what_is_wrong_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: list[str], message: str
) -> None:
    assert main(["render", SCENE, "-o", str(tmp_path / "a.exr"), *VIEW, *change]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_folder_that_does_not_exist(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "a.exr"
    assert main(["render", SCENE, "-o", str(out), *VIEW, "--spp", "2"]) == 0
    assert out.exists()
