"""Cut-outs: triangles of which a texture's alpha takes parts away, cut along its texels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from deepshade_workers.scenes.bitmap import CLAMP, MIRROR, Surface
from deepshade_workers.scenes.mesh import Floats, Mesh

# A mesh gets about so many triangles at most; then what is still mixed goes by its middle.
BUDGET = 200_000
# Corners of a triangle's quarters, as weights of its own corners.
QUARTERS = (
    np.array(
        [
            [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
            [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
            [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
            [[1, 1, 0], [0, 1, 1], [1, 0, 1]],
        ]
    )
    / 2
)


def cut(mesh: Mesh, surface: Surface) -> Mesh:
    """The part of `mesh`, all of which is `surface`, where its alpha reaches the cut-off.

    Triangles that hold both are quartered until they don't or are smaller than a texel.
    """
    opacity = surface.opacity()
    if opacity is None:
        return mesh
    there = opacity >= (surface.cutoff or 0)
    if there.all() or not there.any() or mesh.paint is None:
        return mesh.part(np.full(len(mesh.faces), bool(there.all())))
    places, there = _unwrapped(mesh.paint.uv, there, surface.wrap)
    parents, weights = _quartered(places, there)
    return _pieces(mesh, parents, weights)


def _unwrapped(
    uv: Floats, there: NDArray[np.bool_], wrap: tuple[int, int]
) -> tuple[Floats, NDArray[np.bool_]]:
    """(F, 3, 2) coordinates in texels of a picture that repeats, whatever the other does."""
    places = uv.copy()
    for axis, mode in enumerate(wrap):
        size = there.shape[1 - axis]
        if mode == MIRROR:
            there = np.concatenate([there, np.flip(there, 1 - axis)], 1 - axis)
        elif mode == CLAMP:
            places[..., axis] = np.clip(places[..., axis], 0.5 / size, 1 - 0.5 / size)
        places[..., axis] *= size
    return places, there


def _quartered(places: Floats, there: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Floats]:
    """What remains of triangles (F, 3, 2) in texels: pieces' triangles and corners' weights."""
    sums = np.pad(np.tile(there, (2, 2)), ((1, 0), (1, 0))).cumsum(0, np.int32).cumsum(1)
    size = np.array(there.shape[::-1])
    parents = np.arange(len(places))
    weights = np.tile(np.eye(3), (len(places), 1, 1))
    kept_parents, kept_weights, count = [parents[:0]], [weights[:0]], 0
    while len(parents):
        corners = weights @ places[parents]
        low = np.floor(corners.min(1)).astype(np.int64)
        span = np.maximum(np.ceil(corners.max(1)).astype(np.int64) - low, 1)
        fits = (span <= size).all(1)
        x, y = np.moveaxis(low % size, -1, 0)
        w, h = np.moveaxis(np.minimum(span, size), -1, 0)
        inside = sums[y + h, x + w] - sums[y, x + w] - sums[y + h, x] + sums[y, x]
        mixed = (inside > 0) & (inside < w * h) | ~fits & (inside > 0)
        small = (np.ptp(corners, 1) <= 1).all(1)
        if count + 4 * mixed.sum() > BUDGET:
            small[:] = True
        middle = np.floor(corners.mean(1)).astype(np.int64) % size
        keep = np.where(mixed, small & there[middle[:, 1], middle[:, 0]], inside > 0)
        split = mixed & ~small
        kept_parents.append(parents[keep])
        kept_weights.append(weights[keep])
        count += int(keep.sum())
        parents = np.repeat(parents[split], 4)
        weights = (QUARTERS[None] @ weights[split][:, None]).reshape(-1, 3, 3)
    return np.concatenate(kept_parents), np.concatenate(kept_weights)


def _pieces(mesh: Mesh, parents: NDArray[np.int64], weights: Floats) -> Mesh:
    corners = weights @ mesh.vertices[mesh.faces[parents]]
    normals = weights @ mesh.normals[parents]
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
    part = mesh.part(parents)
    assert part.paint is not None
    paint = replace(part.paint, uv=weights @ part.paint.uv, colour=weights @ part.paint.colour)
    faces = np.arange(3 * len(parents)).reshape(-1, 3)
    return replace(part, vertices=corners.reshape(-1, 3), faces=faces, normals=normals, paint=paint)
