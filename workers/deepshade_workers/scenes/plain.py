"""Meshes that trimesh reads: OBJ, PLY, STL and OFF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from deepshade_workers.scenes.bitmap import BARE, Picture, Surface, to_linear
from deepshade_workers.scenes.cutouts import cut
from deepshade_workers.scenes.mesh import Mesh, Paint, merge
from deepshade_workers.scenes.resources import Resources
from deepshade_workers.scenes.wavefront import load_obj


def load_plain(path: Path) -> Mesh:
    """All meshes of a file; each is an object, as trimesh splits it (an OBJ by materials).

    Raises:
        Exception: whatever trimesh's parsers do with a file that is damaged.
    """
    import trimesh

    resources = Resources(path)
    surfaces: Mapping[str, Surface] = {}
    if path.suffix.lower() == ".obj":
        loaded, surfaces = load_obj(path, resources)
    else:
        loaded = trimesh.load_scene(path, process=False)
    found, frames = {}, []
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        part = loaded.geometry[name]
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            mesh = _convert(part, surfaces, path, resources)
            frames.append(np.asarray(matrix, np.float64))
            found[node] = mesh.transformed(frames[-1])
    if not found:
        return Mesh.build(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    return replace(merge(found.values(), list(found), frames), notes=tuple(resources.notes))


def _convert(part: Any, surfaces: Mapping[str, Surface], path: Path, resources: Resources) -> Mesh:
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    normals = np.asarray(part.vertex_normals) if "vertex_normals" in part._cache else None
    surface = _surface(part.visual, surfaces, path)
    colour = _colours(part.visual, faces)
    paint = None
    if colour is not None or (surface is not None and not surface.plain):
        paint = Paint.none(len(faces))
        bitmap = (surface or BARE).bitmap
        paint = replace(paint, bitmap=np.zeros(len(faces), np.int64), bitmaps=(bitmap,))
        uv = getattr(part.visual, "uv", None)
        if uv is not None and len(uv) == len(vertices):
            # rows of pictures are counted from above, these coordinates from below
            paint = replace(paint, uv=(np.asarray(uv)[:, :2] * (1, -1) + (0, 1))[faces])
        if colour is not None:
            paint = replace(paint, colour=colour)
    material = None if surface is None else surface.material
    mesh = Mesh.of_file(vertices, faces, normals, material=material, paint=paint)
    if surface is None:
        return mesh
    left = cut(mesh, surface)
    if len(left.faces) < len(mesh.faces) and surface.base_picture is None:
        resources.note_transparent(len(mesh.faces), surface.alpha)
    return left


def _surface(visual: Any, surfaces: Mapping[str, Surface], path: Path) -> Surface | None:
    """The surface of trimesh's `visual`; None where the file says nothing."""
    material = getattr(visual, "material", None)
    if material is None:
        return None
    if path.suffix.lower() == ".obj":
        return surfaces.get(getattr(material, "name", None) or "")
    image = getattr(material, "image", None)
    if image is None:
        return None
    return replace(BARE, base_picture=Picture.of(image))


def _colours(visual: Any, faces: Any) -> Any:
    """(F, 3, 3) linear colours of corners from sRGB ones of vertices or faces; None without."""
    kind = getattr(visual, "kind", None)
    if kind not in ("vertex", "face") or not visual.defined:
        return None
    if kind == "vertex":
        found = np.asarray(visual.vertex_colors)[faces]
    else:
        found = np.repeat(np.asarray(visual.face_colors)[:, None], 3, 1)
    return to_linear(found[..., :3] / 255)
