"""Triangle meshes with Phong materials: the geometry that every scene is made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from deepshade_workers.scenes.bitmap import Bitmap

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """Phong reflectances in [0, 1], exponent and scattering mean free path (scene units)."""

    diffuse: tuple[float, float, float] = (0.7, 0.7, 0.7)
    specular: tuple[float, float, float] = (0.04, 0.04, 0.04)
    gloss: float = 16.0
    scatter: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def row(self) -> Floats:
        """(10,) values in the order of `Mesh.materials`."""
        return np.array([*self.diffuse, *self.specular, self.gloss, *self.scatter])


class Object(NamedTuple):
    """A part of a mesh that moves as one: its faces are `start` to `stop` - 1.

    `frame` are the nine numbers, row by row, of the matrix that brings directions of the space
    that it was modelled in to the world; () where that is the world's.
    """

    name: str
    start: int
    stop: int
    frame: tuple[float, ...] = ()


@dataclass(frozen=True)
class Paint:
    """Textures of a mesh: at each corner `uv` (F, 3, 2) and a linear `colour` (F, 3, 3).

    `bitmap` (F,) says which of `bitmaps` lies on a face, times the colour; where it is -1 none
    does, and the face's row of `Mesh.materials` counts.
    """

    uv: Floats
    colour: Floats
    bitmap: Ints
    bitmaps: tuple[Bitmap, ...]

    @classmethod
    def none(cls, count: int) -> Paint:
        """That of `count` faces without textures."""
        return cls(np.zeros((count, 3, 2)), np.ones((count, 3, 3)), np.full(count, -1), ())

    def part(self, keep: NDArray[np.bool_] | Ints) -> Paint:
        """That of some of the faces."""
        return replace(self, uv=self.uv[keep], colour=self.colour[keep], bitmap=self.bitmap[keep])


@dataclass(frozen=True)
class Mesh:
    """Triangles with a normal per corner.

    `vertices` (V, 3), `faces` (F, 3) indices, `normals` (F, 3, 3) one unit normal per corner,
    `materials` (F, 10) rows of `Material.row`. Counter-clockwise faces look outward. `objects`
    follow each other and hold all faces; none where the mesh is part of an object. `notes` say
    what of the file could not be had.
    """

    vertices: Floats
    faces: Ints
    normals: Floats
    materials: Floats = field(repr=False)
    objects: tuple[Object, ...] = ()
    paint: Paint | None = field(default=None, repr=False)
    notes: tuple[str, ...] = ()

    @classmethod
    def build(
        cls,
        vertices: Floats,
        faces: Ints,
        *,
        crease: float = 30.0,
        material: Material | None = None,
        vertex_normals: Floats | None = None,
        paint: Paint | None = None,
    ) -> Mesh:
        """Make a mesh, dropping degenerate and non-finite triangles; `paint` is of all `faces`.

        Without `vertex_normals` (V, 3), edges sharper than `crease` degrees stay sharp; 0 gives
        flat faces and 180 smooths everything.
        """
        vertices = np.asarray(vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(faces, np.int64).reshape(-1, 3)
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        cross = np.cross(b - a, c - a)
        area = np.linalg.norm(cross, axis=1)
        keep = np.isfinite(area) & (area > 0)
        faces, cross, area = faces[keep], cross[keep], area[keep]
        flat = cross / area[:, None]
        if vertex_normals is not None:
            corner = np.asarray(vertex_normals, np.float64)[faces]
        elif crease <= 0:
            corner = np.repeat(flat[:, None], 3, axis=1)
        else:
            corner = _smooth(faces, cross, flat, float(np.cos(np.radians(min(crease, 180)))))
        length = np.linalg.norm(corner, axis=2, keepdims=True)
        good = np.isfinite(length) & (length > 1e-8)
        corner = np.where(good, corner / np.where(good, length, 1), flat[:, None])
        rows = np.tile((material or Material()).row(), (len(faces), 1))
        return cls(vertices, faces, corner, rows, paint=paint and paint.part(keep))

    @classmethod
    def of_file(
        cls,
        vertices: Floats,
        faces: Ints,
        normals: Floats | None,
        *,
        material: Material | None = None,
        paint: Paint | None = None,
    ) -> Mesh:
        """A mesh with a file's normals (V, 3); without, edges sharper than 40° stay sharp."""
        if normals is not None and len(normals) == len(vertices):
            return cls.build(
                vertices, faces, vertex_normals=normals, material=material, paint=paint
            )
        # vertices at the same place become one, so that normals smooth across texture seams
        unique, place = np.unique(vertices, axis=0, return_inverse=True)
        return cls.build(
            unique, place.reshape(-1)[faces], crease=40, material=material, paint=paint
        )

    def transformed(self, matrix: Floats) -> Mesh:
        """Apply a (4, 4) affine `matrix`; normals follow the inverse transpose."""
        linear = matrix[:3, :3]
        vertices = self.vertices @ linear.T + matrix[:3, 3]
        normals = self.normals @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
        moved = replace(self, vertices=vertices, normals=normals)
        return moved.flipped() if np.linalg.det(linear) < 0 else moved

    def part(self, keep: NDArray[np.bool_] | Ints) -> Mesh:
        """The faces of which `keep` (F,) says so, or that it names, of no object."""
        paint = self.paint and self.paint.part(keep)
        kept = self.faces[keep], self.normals[keep], self.materials[keep]
        return Mesh(self.vertices, *kept, paint=paint)

    def flipped(self) -> Mesh:
        """The same triangles with their corners in the other order, and so facing the other way."""
        paint = self.paint
        if paint is not None:
            paint = replace(paint, uv=paint.uv[:, ::-1], colour=paint.colour[:, ::-1])
        return replace(self, faces=self.faces[:, ::-1], normals=self.normals[:, ::-1], paint=paint)


def merge(meshes: Iterable[Mesh], names: Sequence[str] = (), frames: Sequence[Floats] = ()) -> Mesh:
    """One mesh of all, so that a ray tracer sees a single shape.

    `names`, one for each mesh, say which objects they belong to: neighbours of equal name are one.
    `frames` (4, 4) or (3, 3), one for each, have brought them to the world (`Object.frame`).
    """
    parts = list(meshes)
    ends = np.cumsum([len(part.faces) for part in parts])
    objects: list[Object] = []
    turned = [_frame(each) for each in frames] or [()] * len(names)
    for name, part, end, own in zip(names, parts, ends.tolist(), turned, strict=bool(names)):
        start = end - len(part.faces)
        if objects and objects[-1].name == name:
            start, own = objects[-1].start, objects.pop().frame
        objects.append(Object(name, start, end, own))
    starts = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.materials for part in parts]),
        tuple(objects),
        _merged_paint(parts),
        tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _frame(matrix: Floats) -> tuple[float, ...]:
    """What directions are turned by; () for nothing."""
    linear = matrix[:3, :3]
    return () if np.array_equal(linear, np.eye(3)) else tuple(linear.ravel().tolist())


def _merged_paint(parts: Sequence[Mesh]) -> Paint | None:
    """One table of bitmaps for all: equal ones, such as a pack's palette, are there once."""
    if all(part.paint is None for part in parts):
        return None
    paints = [part.paint or Paint.none(len(part.faces)) for part in parts]
    bitmaps = {bitmap.key: bitmap for paint in paints for bitmap in paint.bitmaps}
    places = {key: place for place, key in enumerate(bitmaps)}
    tables = [np.array([*(places[b.key] for b in paint.bitmaps), -1]) for paint in paints]
    return Paint(
        np.concatenate([paint.uv for paint in paints]),
        np.concatenate([paint.colour for paint in paints]),
        np.concatenate([table[paint.bitmap] for table, paint in zip(tables, paints, strict=True)]),
        tuple(bitmaps.values()),
    )


def _smooth(faces: Ints, cross: Floats, flat: Floats, least: float) -> Floats:
    """Corner normals (F, 3, 3): the area-weighted mean over the faces around a corner's vertex.

    Only faces count whose own normal has a cosine of at least `least` with the corner's face.
    """
    corners = faces.ravel()
    order = np.argsort(corners, kind="stable")
    _, start, degree = np.unique(corners[order], return_index=True, return_counts=True)
    total = np.zeros((len(corners), 3))
    # Vertices of equal degree at once: all pairs of their corners, as one (n, d, d) block.
    for d in np.unique(degree):
        first = start[degree == d]
        for chunk in np.array_split(first, max(1, len(first) * d * d // 2_000_000)):
            around = order[chunk[:, None] + np.arange(d)]  # (n, d) corners of each vertex
            face = around // 3
            near = np.einsum("nak,nbk->nab", flat[face], flat[face]) >= least - 1e-9
            total[around.ravel()] = np.einsum("nab,nbk->nak", near, cross[face]).reshape(-1, 3)
    return total.reshape(-1, 3, 3)
