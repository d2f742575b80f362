"""Opens scenes by name: mesh files, Mitsuba XML, `procedural:<family>:<seed>` and
`compose:<parts>:<seed>`."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from pathlib import Path

from deepshade.errors import SceneError, nearest
from deepshade_workers.scenes.composition import compose, files_of
from deepshade_workers.scenes.gltf import load_gltf
from deepshade_workers.scenes.mesh import Mesh
from deepshade_workers.scenes.plain import load_plain
from deepshade_workers.scenes.procedural import FAMILIES, generate
from deepshade_workers.scenes.scene import Scene

GLTF_SUFFIXES = {".gltf", ".glb"}
MESH_SUFFIXES = GLTF_SUFFIXES | {".obj", ".ply", ".stl", ".off"}
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
    Normals of the file are kept; where there are none, edges sharper than 40° stay sharp. The
    mesh's `notes` name what was missing.

    Raises:
        SceneError: there is no such file, it can't be read, or it holds no triangles.
    """
    if not path.is_file():
        raise SceneError(f"there is no scene file {path}")
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneError(
            f"{path}: unknown scene format {path.suffix!r}",
            fix=f"known formats: {', '.join(sorted(SUFFIXES))}",
        )
    read = load_gltf if suffix in GLTF_SUFFIXES else load_plain
    try:
        mesh = read(path)
    except SceneError:
        raise
    except Exception as error:  # trimesh raises whatever its many parsers do
        what = f"no {error}" if isinstance(error, KeyError) else error
        raise SceneError(f"{path} can't be read: {what}") from error
    if not len(mesh.faces):
        raise SceneError(f"{path} holds no triangles")
    return mesh


def notes_of(names: Iterable[str]) -> tuple[str, ...]:
    """What is missing of the mesh files among scenes' `names`: some textures, say.

    Raises:
        SceneError: a file can't be read.
    """
    paths: dict[Path, None] = {}
    for name in names:
        kind = name.split(":")[0]
        if kind == COMPOSED:
            found = files_of(parse_composed(name)[0], frozenset(MESH_SUFFIXES))
        else:
            found = (Path(name),)
        paths |= {path: None for path in found if path.suffix.lower() in MESH_SUFFIXES}
    notes: list[str] = []
    for path in paths:
        if path.is_file():
            mesh = load_mesh(path)  # the one before lives until then: a pack's texture is made once
            notes += mesh.notes
    return tuple(notes)


_kept = functools.lru_cache(maxsize=256)(load_mesh)
