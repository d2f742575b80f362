"""Opens scenes by name: mesh files, Mitsuba XML, `procedural:<family>:<seed>` and
`compose:<parts>:<seed>`."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.errors import SceneError, nearest
from deepshade_workers.scenes.composition import compose, files_of
from deepshade_workers.scenes.mesh import Material, Mesh, merge
from deepshade_workers.scenes.procedural import FAMILIES, generate
from deepshade_workers.scenes.scene import Scene

MESH_SUFFIXES = {".obj", ".ply", ".gltf", ".glb", ".stl", ".off"}
SUFFIXES = MESH_SUFFIXES | {".xml"}
PROCEDURAL = "procedural"
COMPOSED = "compose"


@functools.lru_cache(maxsize=4)
def open_scene(name: str) -> Scene:
    """Open a scene file, or make `procedural:<family>:<seed>` or `compose:<parts>:<seed>`.

    Raises:
        SceneError: there is no such file or family, or it can't be read.
    """
    if name.split(":")[0] == COMPOSED:
        parts, seed = parse_composed(name)
        if seed is None:
            raise SceneError(f"{name!r} names no seed", fix=f"write {name}:1, say")
        files = files_of(parts, frozenset(MESH_SUFFIXES))
        return Scene.from_mesh(name, compose(parts, files, _kept, seed))
    if name.split(":")[0] == PROCEDURAL:
        family, seed = parse_procedural(name)
        if seed is None:
            raise SceneError(f"{name!r} names no seed", fix=f"write {name}:1, say")
        return Scene.from_mesh(name, generate(family, seed))
    path = Path(name)
    if path.suffix.lower() == ".xml" and path.is_file():
        return Scene.from_xml(path)
    return Scene.from_mesh(path.stem, load_mesh(path))


def parse_procedural(name: str) -> tuple[str, int | None]:
    """Split `procedural:<family>[:<seed>]`; raises SceneError for an unknown family."""
    family, seed = [*name.split(":"), "", ""][1:3]
    if family not in FAMILIES:
        near = nearest(family, FAMILIES)
        hint = f"did you mean {near}? " if near else ""
        raise SceneError(
            f"no procedural family {family!r}", fix=f"{hint}there are {', '.join(FAMILIES)}"
        )
    if seed and not seed.isdecimal():
        raise SceneError(f"the seed in {name!r} must be a whole number, 0 or more")
    return family, int(seed) if seed else None


def parse_composed(name: str) -> tuple[str, int | None]:
    """Split `compose:<parts>[:<seed>]`; raises SceneError where no part holds a mesh file."""
    rest = name.partition(":")[2]
    parts, _, seed = rest.rpartition(":")
    if not (parts and seed.isdecimal()):
        parts, seed = rest, ""
    files_of(parts, frozenset(MESH_SUFFIXES))
    return parts, int(seed) if seed else None


def is_unseeded(name: str) -> bool:
    """Whether `name` stands for any scene of its kind, one for each seed."""
    kind = name.split(":")[0]
    if kind == COMPOSED:
        return parse_composed(name)[1] is None
    return kind == PROCEDURAL and parse_procedural(name)[1] is None


def load_mesh(path: Path) -> Mesh:
    """Read every mesh of a file, with its node transforms and materials, into one.

    Each node of the scene graph that holds triangles is an object.
    Normals of the file are kept; where there are none, edges sharper than 40° stay sharp.
    """
    import trimesh

    if not path.is_file():
        raise SceneError(f"there is no scene file {path}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SceneError(
            f"{path}: unknown scene format {path.suffix!r}",
            fix=f"known formats: {', '.join(sorted(SUFFIXES))}",
        )
    try:
        loaded = trimesh.load_scene(path, process=False)
        nodes = loaded.graph.nodes_geometry
        meshes = {node: mesh for node in nodes if (mesh := _placed(loaded, node)) is not None}
    except Exception as error:  # trimesh raises whatever its many parsers do
        raise SceneError(f"{path} can't be read: {error}") from error
    if not any(len(mesh.faces) for mesh in meshes.values()):
        raise SceneError(f"{path} holds no triangles")
    return merge(meshes.values(), list(meshes))


_kept = functools.lru_cache(maxsize=256)(load_mesh)


def _placed(scene: Any, node: str) -> Mesh | None:
    """The mesh of a scene graph's node where its transforms put it; None if it has none.

    trimesh can do this itself (`dump`), but then forgets the normals that the file brought.
    """
    import trimesh

    matrix, name = scene.graph[node]
    part = scene.geometry[name]
    if not isinstance(part, trimesh.Trimesh) or not len(part.faces):
        return None
    if np.linalg.det(matrix[:3, :3]) == 0:
        return None  # squashed flat: some exporters hide things so
    return _convert(part).transformed(np.asarray(matrix, np.float64))


def _convert(part: Any) -> Mesh:
    material = _material(part.visual)
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    if "vertex_normals" in part._cache and len(part.vertex_normals) == len(vertices):
        normals = np.asarray(part.vertex_normals)
        return Mesh.build(vertices, faces, vertex_normals=normals, material=material)
    # vertices at the same place become one, so that normals smooth across texture seams
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    return Mesh.build(unique, index.reshape(-1)[faces], crease=40, material=material)


def _material(visual: Any) -> Material:
    """Phong terms of a trimesh visual; textures count with their mean colour.

    Metallic-roughness materials become Phong ones: diffuse = base (1 - metallic), specular from
    0.04 to base, exponent 2/α² - 2 with α = roughness² (Walter et al. 2007, eq. 33's match).
    """
    material = getattr(visual, "material", None)
    if material is None:
        return Material()
    base = _mean_colour(getattr(material, "baseColorTexture", None))
    factor = getattr(material, "baseColorFactor", None)
    if factor is None:
        factor = getattr(material, "main_color", None)
    if factor is not None:
        scale = 255.0 if np.asarray(factor).dtype.kind in "ui" else 1.0
        base = base * np.asarray(factor, np.float64)[:3] / scale
    metallic = _unit(getattr(material, "metallicFactor", None), 0.0)
    alpha = max(_unit(getattr(material, "roughnessFactor", None), 0.6) ** 2, 0.03)
    diffuse = np.clip(base * (1 - metallic), 0, 1)
    specular = np.clip(0.04 * (1 - metallic) + base * metallic, 0, 1)
    return Material(tuple(diffuse), tuple(specular), float(max(2 / alpha**2 - 2, 1.0)))


def _mean_colour(texture: Any) -> np.ndarray:
    if texture is None:
        return np.ones(3)
    srgb = np.asarray(texture.convert("RGB").resize((64, 64)), np.float64) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear.mean((0, 1)))


def _unit(value: Any, default: float) -> float:
    return default if value is None else float(np.clip(value, 0, 1))
