"""A view that nobody named: from outside an object, from inside a room; and figures of scenes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deepshade.camera import Camera
from deepshade.cli import main
from deepshade_workers.framing import frame
from deepshade_workers.scenes.mesh import Mesh
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace

from .gltfs import Writer, metal_rough


def scene(*parts: Any, inward: bool = False) -> Scene:
    """Of trimesh's shapes."""
    whole = trimesh.util.concatenate(parts)
    faces = whole.faces[:, ::-1] if inward else whole.faces
    return Scene.from_mesh("made", Mesh.build(whole.vertices, faces, crease=0))


def test_a_plane_is_framed_though_no_ray_from_its_box_meets_it(tmp_path: Path) -> None:
    path = tmp_path / "plane.xml"
    path.write_text('<scene version="3.0.0"><shape type="rectangle"/></scene>')
    view = frame(Scene.from_xml(path), 50, 48, 32)
    assert view.eye[2] > 0  # its front


def test_an_object_is_seen_whole_from_outside() -> None:
    found = scene(trimesh.creation.icosphere(radius=3).apply_translation((100, 200, -50)))
    view = frame(found, 50, 64, 48)
    assert view.place == "outside"
    camera = Camera.look_at(view.eye, view.target, (0, 1, 0), 50, 64, 48)
    picture = trace(found, camera, 64, 48).valid.numpy().reshape(48, 64)
    rows, columns = np.nonzero(picture)
    assert rows.min() > 0 and rows.max() < 47  # nothing is cut off
    assert np.ptp(rows) > 36  # and it is not lost in the distance
    assert columns.min() > 0 and columns.max() < 63


@pytest.mark.parametrize("inward", [True, False])
def test_a_room_is_seen_from_inside(inward: bool) -> None:
    """Whose walls look inward; one whose walls look outward is a box."""
    view = frame(scene(trimesh.creation.box((6, 3, 5)), inward=inward), 50, 64, 48)
    inside = bool((np.abs(view.eye) < (3, 1.5, 2.5)).all())
    assert inside == inward
    assert view.place == ("inside" if inward else "outside")


@pytest.fixture
def quad_file(tmp_path: Path) -> Path:
    writer = Writer()
    writer.quad(metal_rough(baseColorFactor=[0.5, 0.25, 0.125, 1], metallicFactor=0))
    writer.quad(metal_rough(baseColorTexture=writer.texture([[(9, 9, 9)]])), 3)
    writer.json["nodes"][1]["name"] = "textured\x1b"
    return writer.write(tmp_path / "quads.glb")


@pytest.mark.slow
def test_what_render_says_makes_the_same_file(
    quad_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (str(tmp_path / name) for name in ("a.exr", "b.exr"))
    common = ["--size", "16x12", "--spp", "2", "--attributes", "position,diffuse"]
    assert main(["render", str(quad_file), "-o", first, *common]) == 0
    said = re.search(r"--eye \S+ \S+ \S+ --target \S+ \S+ \S+", capsys.readouterr().err)
    assert said is not None
    assert main(["render", str(quad_file), "-o", second, *common, *said[0].split()]) == 0
    assert Path(first).read_bytes() == Path(second).read_bytes()


def test_a_target_alone_is_an_error(quad_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(quad_file), "-o", "x.exr", "--target", "0", "0", "0"]) == 2
    assert "--target needs --eye" in capsys.readouterr().err


def test_inspect_says_what_a_scene_holds(
    quad_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["inspect", str(quad_file), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["box"] == [[-1, 0, -1], [4, 0, 1]]
    assert report["triangles"] == 4
    assert [item["triangles"] for item in report["objects"]] == [2, 2]
    assert report["materials"][0]["diffuse"] == [0.5, 0.25, 0.125]
    assert report["textures"][0]["triangles"] == 2
    assert main(["inspect", str(quad_file)]) == 0
    shown = capsys.readouterr().out
    assert "metres" in shown
    assert "\x1b" not in shown
