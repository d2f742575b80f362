"""glTF 2.0 and GLB files, as the specification says: nodes, skins, morph targets, materials.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html. Poses are those of the nodes as the file
has them; animations are not played.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import SceneError
from deepshade_workers.scenes.bitmap import BARE
from deepshade_workers.scenes.cutouts import cut
from deepshade_workers.scenes.gltf_document import Document, open_document
from deepshade_workers.scenes.gltf_material import Texturing, surface_of
from deepshade_workers.scenes.mesh import Floats, Mesh, Paint, merge

# Extensions that are read, or that change nothing of what is rendered.
KNOWN = {
    "EXT_texture_webp",
    "KHR_lights_punctual",
    "KHR_materials_clearcoat",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_variants",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
COMPRESSION = "write it without: gltf-transform cp IN.glb OUT.glb (npm install @gltf-transform/cli)"
CURES = {
    "KHR_draco_mesh_compression": COMPRESSION,
    "EXT_meshopt_compression": COMPRESSION,
    "KHR_texture_basisu": "export it with PNG or JPEG textures",
    "EXT_mesh_gpu_instancing": "export it with each instance as a node of its own",
}
TRIANGLES, STRIP, FAN = 4, 5, 6


def load_gltf(path: Path) -> Mesh:
    """Every triangle of the file's scene, in the world; each node that holds some is an object.

    Raises:
        SceneError: it needs an extension that can't be read.
        OSError, ValueError, KeyError, IndexError: it is damaged, or a buffer is missing.
    """
    document = open_document(path)
    content = document.json
    if not isinstance(content, dict):
        raise ValueError("it is no glTF")
    version = str(content.get("asset", {}).get("version", "2.0"))
    if not version.startswith("2."):
        raise SceneError(f"{path} is glTF {version}", fix="only glTF 2 can be read: export it anew")
    for name in content.get("extensionsRequired", ()):
        if name not in KNOWN:
            raise SceneError(
                f"{path} needs the glTF extension {name}, which can't be read",
                fix=CURES.get(name, "export it without that extension"),
            )
    for name in content.get("extensionsUsed", ()):
        if name not in KNOWN and name in CURES and name.startswith("EXT_mesh_gpu"):
            document.resources.note(f"its {name} can't be read: {CURES[name]}")

    @functools.cache
    def surface(index: int | None) -> Texturing:
        """Material `index`; None is the project's own default, for the file says nothing."""
        return (
            Texturing(None) if index is None else surface_of(document, content["materials"][index])
        )

    worlds = _worlds(content.get("nodes", []))
    parts, names, frames = [], [], []
    taken: set[str] = set()
    for index in _shown(content):
        node = content["nodes"][index]
        if "mesh" not in node:
            continue
        base = node.get("name") or content["meshes"][node["mesh"]].get("name") or f"node {index}"
        name, count = base, 0
        while name in taken:
            count += 1
            name = f"{base}_{count}"
        taken.add(name)
        for primitive in content["meshes"][node["mesh"]]["primitives"]:
            part = _primitive(document, node, primitive, worlds, index, surface)
            if part is not None and len(part.faces):
                parts.append(part)
                names.append(name)
                frames.append(np.eye(4) if "skin" in node else worlds[index])
    if not parts:
        raise SceneError(f"{path} holds no triangles")
    merged = merge(parts, names, frames)
    return replace(merged, notes=tuple(document.resources.notes))


def _local(node: Mapping[str, Any]) -> Floats:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _worlds(nodes: list[Any]) -> list[Floats]:
    """Each node's transform to the world."""
    parents = {child: k for k, node in enumerate(nodes) for child in node.get("children", ())}
    found: dict[int, Floats] = {}
    for start in range(len(nodes)):
        chain = [start]
        while chain[-1] not in found and chain[-1] in parents:
            if len(chain) > len(nodes):
                raise ValueError("its nodes are their own ancestors")
            chain.append(parents[chain[-1]])
        for index in reversed(chain):
            if index not in found:
                above = found.get(parents.get(index, -1))
                local = _local(nodes[index])
                found[index] = local if above is None else above @ local
    return [found[k] for k in range(len(nodes))]


def _shown(content: Mapping[str, Any]) -> Iterator[int]:
    """The nodes of the file's scene, parents first; all of them where it has no scene."""
    nodes = content.get("nodes", [])
    if not content.get("scenes"):
        yield from range(len(nodes))
        return
    waiting = list(reversed(content["scenes"][content.get("scene", 0)].get("nodes", [])))
    seen = set()
    while waiting:
        index = waiting.pop()
        if index not in seen:
            seen.add(index)
            yield index
            waiting += reversed(nodes[index].get("children", []))


def _primitive(
    document: Document,
    node: Mapping[str, Any],
    primitive: Mapping[str, Any],
    worlds: list[Floats],
    index: int,
    surface_at: Callable[[int | None], Texturing],
) -> Mesh | None:
    """One primitive in the world; None where it holds points or lines."""
    attributes = primitive["attributes"]
    if primitive.get("mode", TRIANGLES) not in (TRIANGLES, STRIP, FAN):
        return None
    if "POSITION" not in attributes:
        return None
    arrays = {
        name: document.accessor(place).astype(np.float64)
        for name, place in attributes.items()
        if name in ("POSITION", "NORMAL") or name.startswith(("COLOR_0", "TEXCOORD_"))
    }
    _morph(document, node, primitive, arrays)
    vertices, normals = arrays["POSITION"], arrays.get("NORMAL")
    faces = _faces(document, primitive, len(vertices))
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError("a triangle's corner is no vertex")
    matrix = worlds[index]
    if "skin" in node and "JOINTS_0" in attributes:
        vertices, normals = _skinned(document, node["skin"], attributes, vertices, normals, worlds)
        matrix = np.eye(4)
    if np.linalg.det(matrix[:3, :3]) == 0:
        return None  # squashed flat: some exporters hide things so
    texturing = surface_at(primitive.get("material"))
    paint = _paint(texturing, arrays, faces)
    material = None if texturing.surface is None else texturing.surface.material
    mesh = Mesh.of_file(vertices, faces, normals, material=material, paint=paint)
    mesh = mesh.transformed(matrix)
    surface = texturing.surface
    if surface is None or surface.cutoff is None:
        return mesh
    if surface.base_picture is None and surface.alpha < surface.cutoff:
        document.resources.note_transparent(len(mesh.faces), surface.alpha)
    return cut(mesh, surface)


def _faces(document: Document, primitive: Mapping[str, Any], count: int) -> NDArray[np.int64]:
    corners = np.arange(count)
    if "indices" in primitive:
        corners = document.accessor(primitive["indices"]).astype(np.int64)
    mode = primitive.get("mode", TRIANGLES)
    if mode == TRIANGLES:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    k = np.arange(max(len(corners) - 2, 0))
    if mode == FAN:
        return np.stack([corners[k + 1], corners[k + 2], corners[np.zeros_like(k)]], 1)
    odd = k % 2
    return np.stack([corners[k], corners[k + 1 + odd], corners[k + 2 - odd]], 1)


def _morph(
    document: Document,
    node: Mapping[str, Any],
    primitive: Mapping[str, Any],
    arrays: dict[str, Floats],
) -> None:
    """Add morph targets with the weights that the file gives them."""
    weights = node.get("weights") or document.json["meshes"][node["mesh"]].get("weights", ())
    for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
        for name, place in target.items():
            if weight and name in arrays:
                arrays[name] = arrays[name] + weight * document.accessor(place)


def _skinned(
    document: Document,
    index: int,
    attributes: Mapping[str, int],
    vertices: Floats,
    normals: Floats | None,
    worlds: list[Floats],
) -> tuple[Floats, Floats | None]:
    """Vertices and normals where the joints' nodes put them, in the world."""
    skin = document.json["skins"][index]
    joints = np.stack([worlds[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        joints = joints @ document.accessor(skin["inverseBindMatrices"]).astype(np.float64)
    matrix = np.zeros((len(vertices), 4, 4))
    total = np.zeros(len(vertices))
    for k in range(4):
        if f"JOINTS_{k}" not in attributes:
            break
        numbers = document.accessor(attributes[f"JOINTS_{k}"]).astype(np.int64)
        shares = document.accessor(attributes[f"WEIGHTS_{k}"]).astype(np.float64)
        for number, share in zip(numbers.T, shares.T, strict=True):
            matrix += share[:, None, None] * joints[number]
            total += share
    matrix /= np.where(total > 0, total, 1)[:, None, None]
    moved = (matrix[:, :3, :3] @ vertices[:, :, None])[..., 0] + matrix[:, :3, 3]
    if normals is None:
        return moved, None
    # Normals follow the inverse transpose: the cofactors, but for their length.
    a, b, c = (matrix[:, :3, axis] for axis in range(3))
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 2)
    turned = (cofactors @ normals[:, :, None])[..., 0]
    return moved, turned * np.sign((a * np.cross(b, c)).sum(1, keepdims=True))


def _paint(
    texturing: Texturing, arrays: Mapping[str, Floats], faces: NDArray[np.int64]
) -> Paint | None:
    """The surface's pictures and the vertices' colours at corners; None where there are neither."""
    surface = texturing.surface
    colour = arrays.get("COLOR_0")
    uv = arrays.get(f"TEXCOORD_{texturing.uv_set}")
    if surface is not None and not surface.plain and uv is None:
        uv = np.zeros((len(arrays["POSITION"]), 2))
    if colour is None and (surface is None or surface.plain):
        return None
    found = Paint.none(len(faces))
    if uv is not None:
        placed = np.concatenate([uv, np.ones((len(uv), 1))], 1) @ texturing.transform.T
        found = replace(found, uv=placed[faces])
    if colour is not None:
        found = replace(found, colour=colour[faces][..., :3])
    bitmap = (surface or BARE).bitmap
    return replace(found, bitmap=np.zeros(len(faces), np.int64), bitmaps=(bitmap,))
