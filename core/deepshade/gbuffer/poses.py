"""Where a camera stands, from world-space positions and what it sees of them.

Depth or distance and the field of view give the same points in camera space; the rigid motion
between both is worldToCamera. (Least squares: Kabsch, "A solution for the best rotation to relate
two sets of vectors", 1976.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.gbuffer.channels import Choice
from deepshade.gbuffer.conventions import Conventions
from deepshade.gbuffer.pairs import Pairs
from deepshade.gbuffer.plan import Plan

Float = NDArray[np.float32]

_OFF = 0.01  # share of the depth by which the points may be off in the median
_LEAST = 64  # points


def find_pose(
    plan: Plan,
    conventions: Conventions,
    read: Callable[[Mapping[str, Choice]], Mapping[str, Float]],
) -> None:
    """Adds worldToCamera to a plan that lacks it where its quantities tell it.

    `read` gives quantities of the plan; it is asked only where they are there.
    """
    depths = [name for name in ("depth", "distance") if name in plan.choices]
    if plan.matrix is not None or plan.camera is None or not depths:
        return
    if "position_world" not in plan.choices or conventions.checks == "trust":
        return
    if not any(name.endswith("_world") and name in plan.wanted for name in plan.choices):
        return
    window = plan.parts(plan.choices["position_world"])[0].data_window
    if not plan.complete(plan.choices[depths[0]], window):
        return
    arrays = read({name: plan.choices[name] for name in ("position_world", depths[0])})
    pairs = Pairs.of(arrays["position_world"].shape[1:])
    columns, rows = pairs.columns[0], pairs.rows[0]
    world = pairs.cut(arrays["position_world"])[:, 0]
    along = pairs.cut(arrays[depths[0]])[0, 0]
    with np.errstate(all="ignore"):
        rays = plan.camera.rays_at(columns, rows)
        slant = np.sqrt((rays * rays).sum(0))
        depth = conventions.reading(depths[0]).of(along.astype(np.float32)[None], slant)[0]
        depth = np.abs(depth.astype(np.float64))
        if depths[0] == "distance":
            depth = depth / slant
        seen = plan.camera.points_at(columns, rows, depth)
    good = np.isfinite(seen).all(0) & np.isfinite(world).all(0)
    good &= (depth > 0) & (depth < 1e10) & (world != 0).any(0)
    matrix = rigid(world[:, good], seen[:, good])
    if matrix is None:
        return
    off = matrix[:3, :3] @ world[:, good] + matrix[:3, 3:] - seen[:, good]
    if np.median(np.sqrt((off * off).sum(0)) / depth[good]) < _OFF:
        plan.matrix = matrix
        plan.camera = replace(plan.camera, world_to_camera=matrix)
        plan.pose = f"worldToCamera from world-space positions and {depths[0]}"


def rigid(world: NDArray[Any], seen: NDArray[Any]) -> NDArray[np.float64] | None:
    """The rotation, or reflection, and translation (4, 4) that take points (3, N) to others.

    Points that others contradict (filtered edges) don't count. None for too few of them.
    """
    matrix, inside = np.eye(4), np.ones(world.shape[1], np.bool_)
    for _ in range(4):
        if np.count_nonzero(inside) < _LEAST:
            return None
        a, b = world[:, inside], seen[:, inside]
        middle, other = a.mean(1, keepdims=True), b.mean(1, keepdims=True)
        u, size, vt = np.linalg.svd((b - other) @ (a - middle).T)
        if size[1] <= 1e-6 * size[0]:
            return None  # all in a line
        if size[2] <= 1e-6 * size[0]:  # of one plane: turned, not mirrored
            u[:, 2] *= np.sign(np.linalg.det(u @ vt))
        matrix[:3, :3] = u @ vt
        matrix[:3, 3] = (other - matrix[:3, :3] @ middle)[:, 0]
        off = matrix[:3, :3] @ world + matrix[:3, 3:] - seen
        off = np.sqrt((off * off).sum(0))
        inside = off <= 4 * np.median(off[inside]) + 1e-9 * np.abs(seen).max()
    return matrix
