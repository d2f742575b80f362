"""`deepshade inspect` on files whose answers are known."""

import json
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.cli import main
from deepshade.errors import ConfigError
from deepshade.gbuffer.channels import parse_mapping
from deepshade.inspection import inspect_files


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "shot.exr"
    depth = np.full((6, 8), 3.0, "f")
    depth[0] = np.inf
    depth[1, 1] = np.nan
    normal = np.zeros((3, 6, 8), "f")
    normal[2, 1:] = 0.5
    channels = {f"nornal.{c}": normal[i] for i, c in enumerate("XYZ")} | {"Z": depth}
    exr.write(path, channels, attributes={"deepshade:fov": 50.0}, half=["Z"])
    return path


def test_report(scene):
    report = inspect_files([scene])
    part = report["files"][0]["parts"][0]
    assert part["channels"]["Z"] == "half"
    assert part["data_window"] == [0, 0, 7, 5]
    assert report["camera"]["fov"] == 50
    assert report["mapped"] == {"depth": "Z"}
    ao = report["effects"]["ao"]
    assert ao["ready"]
    assert set(ao["derived"]) == {"position", "normal"}
    aa = report["effects"]["aa"]
    assert not aa["ready"]
    assert list(aa["missing"]) == ["light"]
    depth = report["statistics"]["depth"]
    assert (depth["nonfinite"], depth["background"], depth["depth"]) == (9, 9, [3.0, 3.0])
    assert json.loads(json.dumps(report)) == report


def test_an_effect_is_ready_when_a_bundle_can_shade_it(scene, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "models" / "ao" / "mine"
    folder.mkdir(parents=True)
    config = {"effect": "ao", "inputs": ["normal", "position"]}
    (folder / "config.json").write_text(json.dumps(config))
    monkeypatch.setenv("DEEPSHADE_MODELS", str(tmp_path / "models"))
    found = inspect_files([scene])["effects"]
    assert (found["ao"]["ready"], found["ao"]["bundles"]) == (True, ["mine"])
    assert [name for name, effect in found.items() if effect["ready"]] == ["ao"]
    assert main(["inspect", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "not there" not in text
    assert "no bundle here" in text
    config["inputs"] = ["normal", "light"]
    (folder / "config.json").write_text(json.dumps(config))
    ao = inspect_files([scene])["effects"]["ao"]
    assert (ao["ready"], list(ao["missing"])) == (False, ["light"])


def test_mapping_and_near_misses(scene):
    do = inspect_files([scene])["effects"]["do"]
    assert do["missing"]["normal_world"]["near"] == ["nornal"]
    report = inspect_files([scene], mapping={"normal": "nornal"})
    assert report["effects"]["ao"]["have"] == ["normal"]
    assert report["statistics"]["normal"]["length"] == [0.5, 0.5]
    assert report["statistics"]["normal"]["zero"] == 8


def test_command_prints_tables_without_colour_in_a_pipe(scene, capsys):
    assert main(["inspect", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert "ready" in text
    assert "from depth and the field of view" in text


def test_command_prints_json(scene, capsys):
    assert main(["inspect", str(scene), "--json", "--map", "normal=nornal", "--fov", "40"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["camera"]["fov"] == 40
    assert "normal" in report["mapped"]


def test_ambiguity_is_part_of_the_report(tmp_path):
    path = tmp_path / "two.exr"
    plane = np.ones((2, 2), "f")
    exr.write(path, {f"{a}.normal.{c}": plane for a in "AB" for c in "XYZ"})
    report = inspect_files([path])
    assert report["ambiguous"]["normal"] == ["A.normal", "B.normal"]
    assert "A.normal" in report["effects"]["ao"]["missing"]["normal"]["why"]


def test_names_from_files_cannot_write_to_the_terminal(tmp_path, capsys):
    path = tmp_path / "evil.exr"
    exr.write(path, {"[red]\x1b[2Jx": np.ones((2, 2), "f")})
    assert main(["inspect", str(path)]) == 0
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert "[red]" in text


def test_errors_have_exit_code_2(tmp_path, capsys):
    path = tmp_path / "bad.exr"
    path.write_bytes(b"not an image")
    assert main(["inspect", str(path)]) == 2
    assert "error: not an OpenEXR image" in capsys.readouterr().err


def test_parse_mapping():
    assert parse_mapping(["normal=Nn", "depth = z "]) == {"normal": "Nn", "depth": "z"}
    for bad in (["normal"], ["=x"], ["normal="], ["a=b", "a=c"]):
        with pytest.raises(ConfigError):
            parse_mapping(bad)


def test_lenses_and_views():
    cases = Path(__file__).parents[1] / "cases"
    flat = inspect_files([cases / "ortho_depth_normal.exr"])
    assert "--projection orthographic --ortho-width 3.18" in flat["checks"]["warnings"][0]
    around = inspect_files([cases / "latlong_envmap.exr"])
    assert around["camera"]["projection"] == "latlong"
    stereo = inspect_files([cases / "stereo_hero.exr"], view="right")
    assert (stereo["views"], stereo["view"]) == (["left", "right"], "right")
    assert stereo["mapped"]["depth"] == "right.Z"


def test_a_broken_header_is_part_of_the_report(tmp_path):
    path = tmp_path / "broken.exr"
    planes = {f"{name}.{axis}": np.ones((8, 8), np.float32) for name in "PN" for axis in "XYZ"}
    exr.write(path, planes, attributes={"worldToCamera": np.zeros((4, 4), np.float32)})
    report = inspect_files([path])
    assert "can't be inverted" in report["camera"]["unusable"]["matrix"]
    assert report["camera"]["world_to_camera"] is None
