"""Scene files: formats, transforms, materials, errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from deepshade.errors import SceneError
from deepshade_workers.scenes.loading import load_mesh, open_scene


def cubes() -> trimesh.Scene:
    """Two cubes, one red and turned, the other metallic, scaled and moved."""
    scene = trimesh.Scene()
    for name, colour, metallic in (("red", [200, 0, 0, 255], 0.0), ("gold", [255] * 4, 1.0)):
        cube = trimesh.creation.box((1, 1, 1))
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=colour, metallicFactor=metallic, roughnessFactor=0.5
        )
        cube.visual = trimesh.visual.TextureVisuals(material=material)
        matrix = np.eye(4)
        if name == "gold":
            matrix[:3, :3] *= 2
            matrix[:3, 3] = (5, 0, 0)
        scene.add_geometry(cube, node_name=name, transform=matrix)
    return scene


def test_glb_keeps_transforms_and_materials(tmp_path: Path) -> None:
    cubes().export(tmp_path / "cubes.glb")
    mesh = load_mesh(tmp_path / "cubes.glb")
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    assert np.allclose(corners.min(0), (-0.5, -1, -1))
    assert np.allclose(corners.max(0), (6, 1, 1))
    right = mesh.vertices[mesh.faces].mean(1)[:, 0] > 2
    assert mesh.materials[~right, 0].max() == pytest.approx(200 / 255, abs=0.01)
    assert mesh.materials[right, 0].max() == 0  # metal has no diffuse part
    assert mesh.materials[right, 3].min() == pytest.approx(1, abs=0.01)
    assert {item.name: mesh.materials[item.start, 3] > 0.9 for item in mesh.objects} == {
        "red": False,
        "gold": True,
    }
    assert mesh.materials[0, 6] == pytest.approx(2 / 0.25**2 - 2, rel=0.01)


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl", "off"])
def test_single_meshes(tmp_path: Path, suffix: str) -> None:
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / f"ball.{suffix}")
    mesh = load_mesh(tmp_path / f"ball.{suffix}")
    assert len(mesh.faces) == 320
    center = mesh.vertices[mesh.faces]
    # No normals in the file: a ball's edges are blunt, so it comes out smooth.
    assert (mesh.normals * center).sum(2).min() > 0.97


def test_sharp_edges_stay_sharp(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.obj", include_normals=False)
    normals = load_mesh(tmp_path / "box.obj").normals
    assert np.allclose(np.abs(normals).max(2), 1)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_normals_of_the_file_are_kept(tmp_path: Path, suffix: str) -> None:
    """Normals tilted on purpose come back tilted, turned along with the node."""
    tilted = np.tile([0.6, 0.0, 0.8], (3, 1))
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], vertex_normals=tilted, process=False
    )
    scene = trimesh.Scene()
    turn = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1.0]])
    scene.add_geometry(sheet, transform=turn)
    path = tmp_path / f"tilted.{suffix}"
    if suffix == "glb":
        scene.export(path, include_normals=True)
        expected = turn[:3, :3] @ tilted[0]
    elif suffix == "obj":
        sheet.export(path, include_normals=True)
        expected = tilted[0]
    else:
        sheet.export(path, vertex_normal=True)
        expected = tilted[0]
    assert np.allclose(load_mesh(path).normals, expected, atol=1e-5)


def test_polygons_of_an_obj_are_triangulated(tmp_path: Path) -> None:
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert len(load_mesh(tmp_path / "quad.obj").faces) == 2


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.obj", None, "no scene file"),
        ("text.obj", "hello", "no triangles"),
        ("broken.glb", "glTF nonsense", "can't be read"),
        ("scene.blend", "x", "unknown scene format"),
        ("bad.xml", "<scene", "could not load"),
        ("empty.xml", '<scene version="3.0.0"></scene>', "no bounded geometry"),
    ],
)
def test_what_is_wrong_is_said(
    tmp_path: Path, name: str, content: str | None, message: str
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(SceneError, match=message):
        open_scene(str(tmp_path / name))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("procedural:rom:1", "no procedural family"),
        ("procedural:room", "no seed"),
        ("procedural:room:x", "whole number"),
        ("procedural", "no procedural family"),
    ],
)
def test_procedural_names(name: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        open_scene(name)


def test_a_near_miss_is_offered() -> None:
    with pytest.raises(SceneError) as caught:
        open_scene("procedural:rubbel:1")
    assert "rubble" in caught.value.fix


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "faces"),
    [
        ("zdm2/zdm2.obj", 30_000),
        ("cat/cat-low-resolution.obj", 5_000),
        ("living_room/living_room.gltf", 1_000),
        ("shaderball_teapot/shaderball.glb", 20_000),
    ],
)
def test_real_scenes(shared: Path, name: str, faces: int) -> None:
    mesh = load_mesh(shared / "scenes" / name)
    assert len(mesh.faces) > faces
    assert np.isfinite(mesh.vertices).all()
