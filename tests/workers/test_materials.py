"""Materials of scene files: what G-buffers hold is what the file says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade.errors import SceneError
from deepshade_workers.scenes.bitmap import levels
from deepshade_workers.scenes.loading import load_mesh, open_scene
from deepshade_workers.scenes.mesh import Mesh, merge

from .conftest import seen
from .gltfs import Writer, linear, metal_rough, png

RED, GREEN, BLUE, GREY = (200, 20, 30), (10, 160, 40), (20, 30, 220), (128, 128, 128)
CLAMPED = {"wrapS": 33071, "wrapT": 33071}
NEAREST = {"magFilter": 9728, **CLAMPED}


def test_what_is_drawn_is_what_the_file_says(tmp_path: Path) -> None:
    """Quads side by side: the colour of a palette at each place, factors, defaults, blends."""
    writer = Writer()
    palette = writer.texture([[RED, GREEN], [BLUE, GREY]], **NEAREST)
    ramp = writer.texture([[(0, 0, 0), (255, 255, 255)]], **CLAMPED)
    metals = writer.texture([[(0, 255, 255), (0, 51, 0)]], **NEAREST)  # metal 1 and 0
    matte = {"metallicFactor": 0}
    writer.quad(metal_rough(baseColorTexture=palette, **matte))
    half = [0.5, 0.5, 1, 1]
    paler = metal_rough(baseColorTexture=palette, baseColorFactor=half, **matte)
    writer.quad(paler, 2, COLOR_0=[[1, 0.5, 0.25]] * 4)
    writer.quad(metal_rough(**matte), 4)  # no base colour is white
    writer.quad(metal_rough(), 6)  # and no metallic factor is metal
    writer.quad(metal_rough(baseColorTexture=ramp, **matte), 8)
    rough = metal_rough(baseColorFactor=[0.5] * 4, metallicRoughnessTexture=metals)
    writer.quad(rough, 10)
    scene = open_scene(str(writer.write(tmp_path / "quads.gltf")))
    camera = Camera.look_at((5, 13, 0), (5, 0, 0), (0, 0, -1), 50, 64, 16)
    images = seen(scene, camera, "position", "diffuse", "specular", "gloss")
    x, z = images["position"][0] + 5, -images["position"][1]
    inside = (np.abs(z) < 0.9) & (x > -0.9) & (x < 10.9) & (np.abs((x + 1) % 2 - 1) > 0.1)
    inside &= np.abs(z) > 0.1
    diffuse, specular, gloss = (images[name] for name in ("diffuse", "specular", "gloss"))

    def at(number: int, right: Any = None, low: Any = None) -> Any:
        """Where a quad is, and where its right or left, lower or upper half is."""
        place = inside & (np.abs(x - 2 * number) < 0.95)
        if right is not None:
            place = place & ((x > 2 * number) == right)
        return place if low is None else place & ((z > 0) == low)

    for right, low, colour in ((0, 0, RED), (1, 0, GREEN), (0, 1, BLUE), (1, 1, GREY)):
        value = linear(colour)[:, None]
        bare, tinted = (diffuse[:, at(number, right, low)] for number in (0, 1))
        assert np.abs(bare / value - 1).max() < 2e-3
        assert np.abs(tinted / (value * [[0.5], [0.25], [0.25]]) - 1).max() < 2e-3
    assert diffuse[:, at(2)] == pytest.approx(1)
    assert specular[:, at(2)] == pytest.approx(0.04, rel=1e-3)
    assert diffuse[:, at(3)] == pytest.approx(0)
    assert specular[:, at(3)] == pytest.approx(1)
    assert gloss[:, at(3)] == pytest.approx(1)
    u = (x[at(4)] - 7) / 2  # two texels, black and white, blend between their middles
    assert diffuse[0, at(4)] == pytest.approx(np.clip(2 * u - 0.5, 0, 1), abs=2e-3)
    assert diffuse[:, at(5, 0)] == pytest.approx(0)
    assert specular[:, at(5, 0)] == pytest.approx(0.5)
    assert gloss[:, at(5, 0)] == pytest.approx(1)
    assert diffuse[:, at(5, 1)] == pytest.approx(0.5)
    assert gloss[:, at(5, 1)] == pytest.approx(2 / 0.04**2 - 2, rel=5e-3)  # roughness .2


def test_far_away_it_is_the_textures_mean(tmp_path: Path) -> None:
    writer = Writer()
    checks = np.indices((16, 16)).sum(0) % 2 * 255
    texture = writer.texture(np.repeat(checks[..., None], 3, 2))
    writer.quad(metal_rough(baseColorTexture=texture, metallicFactor=0))
    scene = open_scene(str(writer.write(tmp_path / "checks.glb")))
    camera = Camera.look_at((0.03, 40, 0.02), (0.03, 0, 0.02), (0, 0, -1), 50, 64, 48)
    found = seen(scene, camera, "diffuse", "depth")
    there = np.isfinite(found["depth"][0])
    assert there.sum() >= 2
    assert found["diffuse"][:, there] == pytest.approx(0.5, abs=1e-2)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (8, 2), (7, 7)])
def test_levels_keep_the_mean(size: tuple[int, int]) -> None:
    texels = np.random.default_rng(1).random((*size, 8)).astype(np.float16)
    found = levels(texels)
    assert found[-1].shape == (1, 1, 8)
    assert found[-1][0, 0] == pytest.approx(texels.astype(float).mean((0, 1)), abs=2e-3)


def test_specular_glossiness(tmp_path: Path) -> None:
    """KHR_materials_pbrSpecularGlossiness: the diffuse colour is what specular leaves."""
    terms = {"diffuseFactor": [0.5, 0.4, 0.2, 1], "specularFactor": [0.1, 0.2, 0.6]}
    extension = {"KHR_materials_pbrSpecularGlossiness": {**terms, "glossinessFactor": 0.5}}
    writer = Writer()
    writer.quad({"extensions": extension})
    row = load_mesh(writer.write(tmp_path / "a.gltf")).materials[0]
    assert row[:3] == pytest.approx([0.2, 0.16, 0.08])
    assert row[3:6] == pytest.approx([0.1, 0.2, 0.6])
    assert row[6] == pytest.approx(2 / 0.5**4 - 2)


def test_a_texture_transform_moves_coordinates(tmp_path: Path) -> None:
    """KHR_texture_transform: scaled, turned, moved, in this order."""
    writer = Writer()
    change = {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [2, 3]}
    texture = {**writer.texture([[RED]]), "extensions": {"KHR_texture_transform": change}}
    writer.quad(metal_rough(baseColorTexture=texture))
    paint = load_mesh(writer.write(tmp_path / "a.gltf")).paint
    assert paint is not None
    # (u, v) -> (3 v, -2 u) + offset: counter-clockwise, where v points down
    corners = [[3.25, 0.5], [3.25, -1.5], [0.25, -1.5]]
    assert paint.uv[0] == pytest.approx(np.array(corners))


@pytest.mark.parametrize(
    ("mode", "alpha", "share"),
    [
        ("MASK", (255, 0, 0, 255), 0.5),
        ("BLEND", (255, 120, 130, 255), 0.75),
        ("OPAQUE", [0] * 4, 1),
    ],
)
def test_what_is_cut_out_is_not_there(
    tmp_path: Path, mode: str, alpha: tuple[int, ...], share: float
) -> None:
    """Of four texels those below the cut-off are gone: the area says how many."""
    writer = Writer()
    pixels = np.array([[*RED, a] for a in alpha]).reshape(2, 2, 4)
    material = metal_rough(baseColorTexture=writer.texture(pixels))
    writer.quad({**material, "alphaMode": mode})
    mesh = load_mesh(writer.write(tmp_path / "a.gltf"))
    assert area(mesh) == pytest.approx(4 * share)
    middles = mesh.vertices[mesh.faces].mean(1)
    column, row = middles[:, 0] > 0, middles[:, 2] > 0
    assert all(alpha[k] > 127 or mode == "OPAQUE" for k in 2 * row + column)


def test_a_round_hole_has_its_area(tmp_path: Path) -> None:
    writer = Writer()
    y, x = (np.indices((64, 64)) + 0.5) / 32 - 1
    hole = np.where(x * x + y * y < 0.49, 0, 255)
    pixels = np.concatenate([np.full((64, 64, 3), 90), hole[..., None]], 2)
    material = metal_rough(baseColorTexture=writer.texture(pixels))
    writer.quad({**material, "alphaMode": "MASK"})
    mesh = load_mesh(writer.write(tmp_path / "a.gltf"))
    assert area(mesh) == pytest.approx(4 * (hole > 0).mean(), rel=1e-2)
    assert len(mesh.faces) < 6000  # not every texel is two triangles
    assert np.allclose(mesh.normals, (0, 1, 0))


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_glass_is_left_out_and_said(tmp_path: Path) -> None:
    writer = Writer()
    writer.quad(metal_rough())
    writer.quad({**metal_rough(baseColorFactor=[1, 1, 1, 0.2]), "alphaMode": "BLEND"}, 2)
    mesh = load_mesh(writer.write(tmp_path / "a.gltf"))
    assert len(mesh.faces) == 2
    assert "2 triangles of opacity 0.2 are left out" in mesh.notes[0]


def test_a_skin_follows_its_joints(tmp_path: Path) -> None:
    """One joint rests, one is turned by 90° about z and moved: each vertex goes with its own."""
    writer = Writer()
    half = np.sqrt(0.5)
    turned = {"rotation": [0, 0, half, half], "translation": [5, 0, 0]}
    joints = [writer.add("nodes", {}), writer.add("nodes", turned)]
    binds = np.stack([np.eye(4)] * 2)
    binds[1, :3, 3] = (-1, 0, 0)
    writer.add("skins", {"joints": joints, "inverseBindMatrices": writer.array(binds)})
    numbers = writer.array([[0, 1, 0, 0]] * 4, "uint8")
    weights = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [0.5, 0.5, 0, 0]]
    writer.quad(x=100, WEIGHTS_0=weights)  # the node's own place doesn't count
    writer.json["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"] = numbers
    writer.json["nodes"][-1]["skin"] = 0
    mesh = load_mesh(writer.write(tmp_path / "a.glb"))

    def moved(p: Any) -> Any:
        return np.array([-p[1] + 5, p[0] - 1, p[2]])

    corners = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], float)
    expected = [corners[0], moved(corners[1]), moved(corners[2])]
    expected.append((corners[3] + moved(corners[3])) / 2)
    assert mesh.vertices == pytest.approx(np.array(expected), abs=1e-6)
    assert mesh.normals[0, 0] == pytest.approx((0, 1, 0))
    assert mesh.normals[0, 1] == pytest.approx((-1, 0, 0), abs=1e-6)


def test_accessors_of_every_kind_agree(tmp_path: Path) -> None:
    """Strides, normalised integers and sparse replacements, against the plain arrays."""
    plain = Writer()
    plain.quad(COLOR_0=[[1, 0.2, 0], [0, 1, 0.2], [0.4, 0, 1], [1, 1, 1]])
    other = Writer()
    other.quad()
    places = other.json["meshes"][0]["primitives"][0]["attributes"]
    colours = np.array([[255, 51, 0], [0, 255, 51], [102, 0, 255], [255] * 3], np.uint8)
    rows = np.concatenate([colours, np.zeros((4, 5), np.uint8)], 1)
    number = other.array(rows.ravel(), "uint8")
    accessor = other.json["accessors"][number]
    other.json["bufferViews"][accessor["bufferView"]]["byteStride"] = 8
    accessor |= {"count": 4, "type": "VEC3", "normalized": True}
    places["COLOR_0"] = number
    place = other.array([[-1, 0, 1], [9, 9, 9], [1, 0, -1], [-1, 0, -1]])
    where, what = other.array([1], "uint16"), other.array([[1, 0, 1]])
    views = [other.json["accessors"][k]["bufferView"] for k in (where, what)]
    other.json["accessors"][place]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": views[0], "componentType": 5123},
        "values": {"bufferView": views[1]},
    }
    places["POSITION"] = place
    first = load_mesh(plain.write(tmp_path / "a.gltf"))
    second = load_mesh(other.write(tmp_path / "b.glb"))
    assert (first.vertices[first.faces] == second.vertices[second.faces]).all()
    assert first.paint is not None and second.paint is not None
    assert first.paint.colour == pytest.approx(second.paint.colour)


def test_nodes_share_names_but_not_objects(tmp_path: Path) -> None:
    writer = Writer()
    for x in (0, 2):
        writer.quad(x=x)
        writer.json["nodes"][-1]["name"] = "leg"
    writer.json["meshes"][0]["primitives"] *= 2  # of one node: one object
    found = load_mesh(writer.write(tmp_path / "a.gltf")).objects
    assert [(item.name, item.stop - item.start) for item in found] == [("leg", 4), ("leg_1", 2)]


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("KHR_draco_mesh_compression", "gltf-transform cp"),
        ("EXT_meshopt_compression", "gltf-transform cp"),
        ("KHR_texture_basisu", "PNG or JPEG"),
        ("ACME_holograms", "without that extension"),
    ],
)
def test_extensions_that_cannot_be_read_are_named(tmp_path: Path, name: str, fix: str) -> None:
    writer = Writer()
    writer.quad()
    writer.json["extensionsRequired"] = [name]
    with pytest.raises(SceneError, match=name) as caught:
        load_mesh(writer.write(tmp_path / "a.gltf"))
    assert fix in caught.value.fix


@pytest.mark.parametrize("damage", ["short", "loop", "corner", "view"])
def test_damaged_files_are_errors(tmp_path: Path, damage: str) -> None:
    writer = Writer()
    writer.quad()
    content = writer.json
    if damage == "short":
        writer.data = writer.data[:-40]
    elif damage == "loop":
        content["nodes"][0]["children"] = [0]
    elif damage == "corner":
        content["accessors"][3]["count"] = 3
        content["accessors"][0]["count"] = 2
    else:
        content["accessors"][0]["bufferView"] = 99
    with pytest.raises(SceneError, match="can't be read"):
        load_mesh(writer.write(tmp_path / "a.glb"))


def test_a_pack_keeps_its_palette_once(tmp_path: Path) -> None:
    meshes = []
    for name in ("chair", "table"):
        writer = Writer()
        writer.quad(metal_rough(baseColorTexture=writer.texture([[RED, BLUE]])))
        meshes.append(load_mesh(writer.write(tmp_path / f"{name}.glb")))
    both = merge([replace(m, objects=()) for m in [*meshes, Mesh.build(*triangle())]])
    assert both.paint is not None
    assert len(both.paint.bitmaps) == 1
    assert both.paint.bitmap.tolist() == [0, 0, 0, 0, -1]


def triangle() -> tuple[Any, Any]:
    return np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])


MTL = """newmtl shiny
Kd 0.5 0.25 0.125
Ks 0.25 0.25 0.25
Ns 96
illum 2
newmtl flat
Kd 0.5 0.5 0.5
Ks 0.25 0.25 0.25
illum 1
newmtl bright
Kd 0.9 0.9 0.9
Ks 0.5 0.5 0.5
newmtl glass
Kd 1 1 1
d 0.1
newmtl painted
map_Kd -s 1 1 1 my palette.png
"""


def obj(tmp_path: Path, *names: str, mtl: str = MTL) -> Mesh:
    """A triangle of each material, whose texture coordinates lie in the upper left texel."""
    (tmp_path / "a.mtl").write_text(mtl)
    lines = ["mtllib a.mtl", "v 0 0 0", "v 1 0 0", "v 0 1 0"]
    lines += ["vt 0.1 0.9", "vt 0.2 0.9", "vt 0.1 0.8"]
    for name in names:
        lines += [f"usemtl {name}", "f 1/1 2/2 3/3"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    return load_mesh(tmp_path / "a.obj")


def test_an_obj_is_what_its_mtl_says(tmp_path: Path) -> None:
    mesh = obj(tmp_path, "shiny", "flat", "bright")
    rows = {item.name: mesh.materials[item.start] for item in mesh.objects}
    assert rows["shiny"][:7] == pytest.approx([0.5, 0.25, 0.125, 0.25, 0.25, 0.25, 96])
    assert rows["flat"][:6] == pytest.approx([0.5] * 3 + [0] * 3)
    assert rows["bright"][:6] == pytest.approx([0.9] * 3 + [0.1] * 3)  # no light from nowhere
    assert mesh.notes == ()


def test_an_mtl_may_have_tabs_comments_and_number_signs_in_names(tmp_path: Path) -> None:
    mtl = "# a comment\nnewmtl\tMaterial #25\n\tKd\t0.5 0.25 0.125  # brown\n#Kd 1 1 1\n"
    mesh = obj(tmp_path, "Material #25", mtl=mtl)
    assert mesh.materials[0][:3] == pytest.approx([0.5, 0.25, 0.125])
    assert mesh.notes == ()


def test_map_kd_is_read_by_coordinates_from_below(tmp_path: Path) -> None:
    (tmp_path / "my palette.png").write_bytes(png([[RED, GREEN], [BLUE, GREY]]))
    mesh = obj(tmp_path, "painted", "glass")
    assert mesh.paint is not None
    assert len(mesh.faces) == 1
    assert any("opacity 0.1" in note for note in mesh.notes)
    texels = mesh.paint.bitmaps[0].texels
    column, row = np.floor(mesh.paint.uv[0] * 2).astype(int).T
    assert texels[row, column, :3] == pytest.approx(np.tile(linear(RED), (3, 1)), rel=2e-3)


@pytest.mark.parametrize(("mask", "left"), [((255, 255, 255), 1), ((0, 0, 0), 0)])
def test_map_d_cuts_out_by_a_file_of_its_own(tmp_path: Path, mask: Any, left: int) -> None:
    (tmp_path / "leaf.png").write_bytes(png([[RED, RED], [RED, RED]]))
    (tmp_path / "mask.png").write_bytes(png([[mask, GREY], [GREY, GREY]]))
    for colour in ("map_Kd leaf.png\n", ""):
        mtl = f"newmtl leaf\nKd 1 0 0\n{colour}map_d mask.png\nnewmtl other\nKd 1 1 1\n"
        mesh = obj(tmp_path, "leaf", "other", mtl=mtl)
        names = {item.name for item in mesh.objects if item.start < item.stop}
        assert names == ({"leaf", "other"} if left else {"other"})
        if left:
            assert mesh.paint is not None
            assert not mesh.paint.bitmaps[0].texels[..., 1:3].any()  # Kd's red


def test_vertex_colours_of_a_ply(tmp_path: Path) -> None:
    import trimesh

    colours = np.array([[*RED, 255], [*GREEN, 255], [*BLUE, 255]], np.uint8)
    sheet = trimesh.Trimesh(*triangle(), vertex_colors=colours, process=False)
    sheet.export(tmp_path / "a.ply")
    paint = load_mesh(tmp_path / "a.ply").paint
    assert paint is not None
    assert paint.colour[0] == pytest.approx(linear([RED, GREEN, BLUE]), rel=1e-3)
    assert paint.bitmaps[0].texels[0, 0, :3] == pytest.approx(1)


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    mesh = obj(tmp_path, "painted")
    assert "its texture my palette.png is missing" in mesh.notes[0]
    mesh = obj(tmp_path, "other")
    assert "its material other is in no library" in mesh.notes[0]
    (tmp_path / "a.mtl").unlink()
    assert "library a.mtl is missing" in load_mesh(tmp_path / "a.obj").notes[0]
    writer = Writer()
    writer.add("images", {"uri": "gone.png"})
    texture = {"index": writer.add("textures", {"source": 0})}
    factor = [0.3, 0.2, 0.1, 1]
    writer.quad(metal_rough(baseColorTexture=texture, baseColorFactor=factor, metallicFactor=0))
    mesh = load_mesh(writer.write(tmp_path / "b.gltf"))
    assert "its texture gone.png is missing" in mesh.notes[0]
    assert mesh.materials[0, :3] == pytest.approx(factor[:3])
    (tmp_path / "gone.png").write_text("no picture")
    assert "gone.png can't be read" in load_mesh(tmp_path / "b.gltf").notes[0]
