"""Ambient occlusion baked onto a mesh: a byte a vertex, or a byte a texel of its triangles.

Texels are those of C. Yuksel, J. Keyser and D. House, *Mesh Colors* (ACM Transactions on Graphics
29(2), 2010), here without sharing along edges: a triangle of resolution R has (R + 1)(R + 2) / 2
of them at the nodes of an even grid, and its surface is linear in between. No unwrapping is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade.errors import SceneError
from deepshade_workers.backend import mitsuba
from deepshade_workers.references.ao import reference
from deepshade_workers.scenes.mesh import Floats, Ints, Mesh
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits
from deepshade_workers.view import View

mi = mitsuba()

Bytes = NDArray[np.uint8]
Float = NDArray[np.float32]
_MOST = 64  # of a triangle's resolution


@dataclass(frozen=True)
class Place:
    """What pixels (n,) see: the triangle, and barycentric coordinates (n, 3) in it."""

    face: Ints
    weights: Floats


@dataclass(frozen=True)
class Vertices:
    """A value for each vertex (V,), and the vertices of faces (F, 3)."""

    values: Bytes
    faces: Ints

    @property
    def size(self) -> int:
        """Bytes."""
        return self.values.nbytes

    def at(self, place: Place) -> Float:
        """(n,) openness, linear in each triangle."""
        corners = self.values[self.faces[place.face]] / np.float32(255)
        return np.asarray((corners * place.weights).sum(1), np.float32)


@dataclass(frozen=True)
class Texels:
    """Values of all triangles' nodes; triangles have a resolution (F,) and a first node."""

    values: Bytes
    start: Ints
    resolution: Ints

    @property
    def size(self) -> int:
        """Bytes."""
        return self.values.nbytes

    def at(self, place: Place) -> Float:
        """(n,) openness, linear between the nodes around."""
        fine = self.resolution[place.face]
        u, v = (place.weights[:, k] * fine for k in (1, 2))
        i = np.minimum(u.astype(np.int64), fine - 1)
        j = np.minimum(v.astype(np.int64), fine - 1 - i)
        a, b = u - i, v - j
        upper = (a + b > 1) & (i + j < fine - 1)  # the half of the cell away from its first node
        ends = np.where(upper, 1 - a, a), np.where(upper, 1 - b, b)
        nodes = [
            (i + upper, j + upper),
            (np.where(upper, i, i + 1), np.where(upper, j + 1, j)),
            (np.where(upper, i + 1, i), np.where(upper, j, j + 1)),
        ]
        shares = 1 - ends[0] - ends[1], ends[0], ends[1]
        found = np.zeros(len(fine), np.float32)
        for (x, y), share in zip(nodes, shares, strict=True):
            index = self.start[place.face] + _node(x, y, fine)
            found += (share * self.values[index] / 255).astype(np.float32)
        return found


def places(mesh: Mesh, hits: Hits) -> Place:
    """What each pixel that shows a surface sees of the mesh that was traced."""
    valid = hits.valid.numpy()
    face = hits.surface.prim_index.numpy()[valid].astype(np.int64)
    a, b, c = mesh.vertices[mesh.faces[face]].swapaxes(0, 1)
    point = hits.p.numpy().T[valid]
    cross = np.cross(b - a, c - a)
    square = np.maximum((cross * cross).sum(1), 1e-300)
    v = (np.cross(b - a, point - a) * cross).sum(1) / square
    u = (np.cross(point - a, c - a) * cross).sum(1) / square
    weights = np.clip(np.stack([1 - u - v, u, v], 1), 0, 1)
    return Place(face, weights / weights.sum(1, keepdims=True))


def bake_vertices(scene: Scene, view: View, samples: int, seed: int) -> Vertices:
    """At each place where corners meet, with the mean of their normals."""
    mesh = _mesh(scene)
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    where, vertex = np.unique(corners, axis=0, return_inverse=True)
    normals = np.zeros_like(where)
    np.add.at(normals, vertex.reshape(-1), mesh.normals.reshape(-1, 3))
    values = _openness(scene, view, where, normals, normals, samples, seed)
    return Vertices(values, vertex.reshape(-1, 3))


def bake_texels(scene: Scene, view: View, budget: int, samples: int, seed: int) -> Texels:
    """At about `budget` places, evenly over the surface, but at least three a triangle."""
    mesh = _mesh(scene)
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2
    low, high = 0.0, budget * 4.0 / area.sum()
    for _ in range(40):  # texels an area, by bisection: resolutions are whole
        middle = (low + high) / 2
        fits = int(_count(_resolutions(area, middle)).sum()) <= budget
        low, high = (middle, high) if fits else (low, middle)
    fine = _resolutions(area, low)
    count = _count(fine)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    where = np.empty((int(count.sum()), 3))
    normals, flats = np.empty_like(where), np.empty_like(where)
    for r in np.unique(fine):
        chosen = np.flatnonzero(fine == r)
        i, j = (each.ravel() for each in np.meshgrid(np.arange(r + 1), np.arange(r + 1)))
        i, j = i[i + j <= r], j[i + j <= r]
        weights = np.stack([r - i - j, i, j]) / r  # (3, nodes)
        weights = 0.98 * weights + 0.02 / 3  # on an edge rays could start in the neighbour
        index = start[chosen][:, None] + _node(i, j, np.full_like(i, r))
        where[index] = np.einsum("kn,fkc->fnc", weights, mesh.vertices[mesh.faces[chosen]])
        normals[index] = np.einsum("kn,fkc->fnc", weights, mesh.normals[chosen])
        flats[index] = (cross / np.maximum(2 * area, 1e-300)[:, None])[chosen][:, None]
    return Texels(_openness(scene, view, where, normals, flats, samples, seed), start, fine)


def _mesh(scene: Scene) -> Mesh:
    if scene.mesh is None:
        raise SceneError(f"{scene.name} is no mesh", fix="give an OBJ, PLY or glTF file")
    return scene.mesh


def _resolutions(area: Floats, density: float) -> Ints:
    return np.clip(np.sqrt(2 * area * density).round(), 1, _MOST).astype(np.int64)


def _count(fine: Ints) -> Ints:
    return (fine + 1) * (fine + 2) // 2


def _node(i: Ints, j: Ints, fine: Ints) -> Ints:
    """The number of the node in column i of row j, of which row j has `fine` + 1 - j."""
    return j * (fine + 1) - j * (j - 1) // 2 + i


def _openness(
    scene: Scene,
    view: View,
    where: Floats,
    normals: Floats,
    flats: Floats,
    samples: int,
    seed: int,
) -> Bytes:
    """(n,) of points with shading and geometric normals (n, 3), in 255ths."""
    count = len(where)
    ns, ng = (
        mi.Vector3f(*(mi.Float(row) for row in _unit(each).T.astype(np.float32, order="C").copy()))
        for each in (normals, flats)
    )
    points = mi.Point3f(*(mi.Float(row) for row in where.T.astype(np.float32, order="C").copy()))
    yes = dr.full(mi.Bool, True, count)
    hits = Hits(count, 1, yes, points, ng, ns, dr.zeros(mi.Float, count), ~yes, None)
    value, _ = reference(scene, view, hits, {}, samples=samples, seed=seed)
    return np.asarray(np.round(value.ravel() * 255), np.uint8)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30))
