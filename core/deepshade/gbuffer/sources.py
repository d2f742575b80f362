"""Of several sources of positions the most exact: 16-bit positions against depth."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.gbuffer.channels import Choice
from deepshade.gbuffer.conventions import Conventions
from deepshade.gbuffer.pairs import Pairs
from deepshade.gbuffer.plan import Plan

Float = NDArray[np.float32]

_FINER = 0.5  # depth has to be so much finer than positions to stand in for them
_AGREE = 0.01  # share of the depth by which both may differ, beside their steps


def passed_over(
    plan: Plan,
    mapping: Collection[str],
    conventions: Conventions,
    read: Callable[[Mapping[str, Choice]], Mapping[str, Float]],
) -> dict[str, str]:
    """Which 16-bit positions depth and the field of view give more exactly, and why.

    `read` gives quantities of the plan; it is asked only where there are both. Positions that a
    `mapping` or the `conventions` name are taken at their word.
    """
    depths = [name for name in ("depth", "distance") if name in plan.choices]
    places = [
        name
        for name in ("position", "position_world")
        if name in plan.choices
        and name not in mapping
        and name not in conventions.axes
        and plan.half(plan.choices[name])
    ]
    if "position" in plan.choices:
        places = [name for name in places if name == "position"]
    elif plan.matrix is None:
        places = []
    if not (depths and places and plan.camera) or conventions.checks == "trust":
        return {}
    if plan.camera.projection != "perspective":
        return {}
    (place, depth) = places[0], depths[0]
    window = plan.parts(plan.choices[place])[0].data_window
    if not plan.complete(plan.choices[depth], window):
        return {}
    arrays = read({name: plan.choices[name] for name in (place, depth)})
    pairs = Pairs.of(arrays[place].shape[1:])
    points, along = (pairs.cut(arrays[name])[:, 0] for name in (place, depth))
    with np.errstate(all="ignore"):
        reading = conventions.reading(depth)
        rays = plan.camera.rays_at(pairs.columns[0], pairs.rows[0])
        slant = np.sqrt((rays * rays).sum(0))
        by_depth = np.abs(reading.of(along.astype(np.float32), slant)[0].astype(np.float64))
        if depth == "distance":
            by_depth /= slant
        placed = points
        if place == "position_world":
            assert plan.matrix is not None
            placed = plan.matrix[:3, :3] @ points + plan.matrix[:3, 3:]
        good = (
            np.isfinite(by_depth) & (by_depth > 0) & (by_depth < 1e10) & np.isfinite(placed).all(0)
        )
        if np.count_nonzero(good) < 16:
            return {}
        coarse = float(np.median(_step(points[:, good], np.float16).max(0)))
        kind = np.float16 if plan.half(plan.choices[depth]) else np.float32
        fine = float(np.median(_step(along[0, good], kind)))
        off = np.abs(np.abs(placed[2]) - by_depth)[good]
        agree = float(np.median(off - _AGREE * by_depth[good])) <= 2 * coarse
    if not agree or fine > _FINER * coarse:
        return {}
    return {
        place: f"the 16 bits of '{place}' make steps of {coarse:.2g}, those of '{depth}' {fine:.2g}"
    }


def _step(values: NDArray[np.float64], kind: Any) -> NDArray[np.float64]:
    """The distance to the next number of that type."""
    step: NDArray[np.float64] = np.abs(np.spacing(values.astype(kind))).astype(np.float64)
    return step
