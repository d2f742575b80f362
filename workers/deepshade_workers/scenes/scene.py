"""A scene ready for ray tracing, and its objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deepshade.errors import SceneError, nearest
from deepshade_workers.backend import mitsuba, two_threads
from deepshade_workers.scenes.mesh import Floats, Ints, Mesh, Object, Paint
from deepshade_workers.view import Vector

if TYPE_CHECKING:
    from deepshade_workers.painting import Painting

# A distant sun and a dim sky: what lights a scene that brings no lights of its own.
SUN_DIRECTION = (-0.45, -0.75, -0.5)
SUN_IRRADIANCE = 2.5
SKY_RADIANCE = 0.35

MATERIAL_CHANNELS = {"diffuse": (0, 3), "specular": (3, 6), "gloss": (6, 7), "scatter": (7, 10)}


@dataclass(frozen=True, eq=False)
class Scene:
    """A Mitsuba scene with its name and bounds (2, 3) in scene units.

    `lit` tells whether the scene brings lights of its own. `objects` are what may move, with their
    faces in the one mesh that is traced; its face attribute "object" holds an object's number at a
    hit. A Mitsuba XML scene tells none.
    Its `mesh` is kept, for what moves is traced by itself; None for an XML scene.
    `points` (n, 3) are places worth looking at, `extent` the size of the region they cover:
    a town on a wide plain is as large as the town. `painting` holds its textures.
    """

    name: str
    traced: Any
    bounds: Floats
    points: Floats
    extent: float
    lit: bool = False
    objects: tuple[Object, ...] = ()
    mesh: Mesh | None = field(default=None, repr=False)
    painting: Painting | None = field(default=None, repr=False)

    @property
    def notes(self) -> tuple[str, ...]:
        """What of its files could not be had."""
        return () if self.mesh is None else self.mesh.notes

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, scene units."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def displacements(self, by_name: Mapping[str, Vector]) -> Floats:
        """(objects, 3): how far each object moves, 0 for those that `by_name` doesn't hold.

        Raises:
            SceneError: no object has one of the names.
        """
        names = [item.name for item in self.objects]
        for name in by_name:
            if name not in names:
                near = nearest(name, names)
                hint = f"did you mean {near!r}? " if near else ""
                raise SceneError(
                    f"scene {self.name!r} has no object {name!r}",
                    fix=f"{hint}it has {', '.join(names[:8]) or 'none that can move'}",
                )
        return np.array([by_name.get(name, (0, 0, 0)) for name in names], np.float64)

    def moving_parts(self, by_name: Mapping[str, Vector]) -> list[tuple[Any, Vector]]:
        """What moves alike, as Mitsuba scenes without lights, each with its displacement.

        Materials are those of this scene, and so are the numbers of objects.

        Raises:
            SceneError: no object has one of the names.
        """
        table = self.displacements(by_name)
        if self.mesh is None or not table.any():
            return [(self.traced, (0.0, 0.0, 0.0))]
        mi = mitsuba()
        numbers = _object_numbers(self.mesh)
        moves, group = np.unique(table, axis=0, return_inverse=True)
        parts: list[tuple[Any, Vector]] = []
        for index, (x, y, z) in enumerate(moves.tolist()):
            keep = group.reshape(-1)[numbers] == index
            if keep.any():
                shape = _shape(mi, self.name, self.mesh.part(keep), numbers[keep])
                # Scenes that one CUDA kernel traces share the shader table of their parent.
                shared = {"type": "scene", "parent": self.traced, "mesh": shape}
                parts.append((mi.load_dict(shared), (x, y, z)))
        return parts

    @classmethod
    def from_mesh(cls, name: str, mesh: Mesh) -> Scene:
        """Build the acceleration structure of one merged mesh, lit by the default sun and sky."""
        if not len(mesh.faces):
            raise SceneError(f"scene {name!r} holds no triangles")
        mi = mitsuba()
        shape = _shape(mi, name, mesh, _object_numbers(mesh))
        lights = {
            "sun": {
                "type": "directional",
                "direction": list(SUN_DIRECTION),
                "irradiance": {"type": "rgb", "value": SUN_IRRADIANCE},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": SKY_RADIANCE}},
        }
        used = mesh.vertices[np.unique(mesh.faces)]
        bounds = np.stack([used.min(0), used.max(0)])
        traced = mi.load_dict({"type": "scene", "mesh": shape, **lights})
        # Where the triangles are small there is something to see; large ones are floors.
        points = mesh.vertices[mesh.faces[:: max(1, len(mesh.faces) // 4096)]].mean(1)
        objects = mesh.objects or (Object(name, 0, len(mesh.faces)),)
        extent = _spread(points)
        painting = _painting(mesh)
        return cls(
            name, traced, bounds, points, extent, objects=objects, mesh=mesh, painting=painting
        )

    @classmethod
    def from_xml(cls, path: Path) -> Scene:
        """Load a Mitsuba XML scene with its own shapes, materials and lights."""
        mi = mitsuba()
        try:
            with two_threads():
                traced = mi.load_file(str(path))
        except RuntimeError as error:
            raise SceneError(f"Mitsuba could not load {path}: {error}") from error
        box = traced.bbox()
        bounds = np.array([box.min, box.max], np.float64).reshape(2, 3)
        if not np.isfinite(bounds).all() or not traced.shapes():
            raise SceneError(f"{path} holds no bounded geometry")
        points = np.random.default_rng(0).uniform(bounds[0], bounds[1], (1024, 3))
        lit = bool(traced.emitters())
        return cls(path.stem, traced, bounds, points, _spread(points), lit)


def _spread(points: Floats) -> float:
    """Diagonal of the box that holds the middle 90 % of `points` along each axis."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def _object_numbers(mesh: Mesh) -> Ints:
    """(F,) the number of the object that each face belongs to."""
    faces = [item.stop - item.start for item in mesh.objects] or [len(mesh.faces)]
    return np.repeat(np.arange(len(faces)), faces)


def _shape(mi: Any, name: str, mesh: Mesh, numbers: Ints) -> Any:
    """One Mitsuba mesh: corners are split so that each carries its own normal.

    `numbers` (F,) are those of the faces' objects.
    """
    corners = mesh.vertices[mesh.faces].reshape(-1, 3).astype(np.float32)
    count = len(mesh.faces)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}})
    shape = mi.Mesh(
        name,
        len(corners),
        count,
        has_vertex_normals=True,
        has_vertex_texcoords=mesh.paint is not None,
        props=props,
    )
    for channel, (start, stop) in MATERIAL_CHANNELS.items():
        values = np.ascontiguousarray(mesh.materials[:, start:stop], np.float32)
        shape.add_attribute(f"face_{channel}", stop - start, values.ravel())
    # Numbers up to 2^24 are exact in float32.
    shape.add_attribute("face_object", 1, numbers.astype(np.float32))
    if mesh.paint is not None:
        _add_paint(shape, mesh, mesh.paint)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(corners.ravel())
    params["vertex_normals"] = mi.Float(mesh.normals.astype(np.float32).ravel())
    if mesh.paint is not None:
        params["vertex_texcoords"] = mi.Float(mesh.paint.uv.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(np.arange(3 * count, dtype=np.uint32))
    params.update()
    return shape


def _painting(mesh: Mesh) -> Painting | None:
    if mesh.paint is None or not mesh.paint.bitmaps:
        return None
    from deepshade_workers.painting import Painting

    return Painting.of(mesh.paint.bitmaps, bool((mesh.paint.colour != 1).any()))


def _add_paint(shape: Any, mesh: Mesh, paint: Paint) -> None:
    """Of faces their bitmap and how often it repeats in a unit of length; corners' colours."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    (ux, uy), (vx, vy) = ((paint.uv[:, k] - paint.uv[:, 0]).T for k in (1, 2))
    density = np.sqrt(np.abs(ux * vy - uy * vx) / np.maximum(area, 1e-30))
    shape.add_attribute("face_bitmap", 1, paint.bitmap.astype(np.float32))
    shape.add_attribute("face_density", 1, density.astype(np.float32))
    shape.add_attribute("vertex_colour", 3, paint.colour.astype(np.float32).ravel())
