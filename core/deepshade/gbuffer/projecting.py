"""Whether positions lie on the rays of their pixels, and as which axes they do."""

from __future__ import annotations

import numpy as np

from deepshade.errors import ContradictionError
from deepshade.gbuffer.axes import AS_STORED, EVERY
from deepshade.gbuffer.examination import FEW, MIN_PAIRS, Array, Examination, Mask
from deepshade.gbuffer.pairs import projection


def check_positions(e: Examination) -> None:
    """Positions lie on the rays of their pixels: which axes make them do so?"""
    stored, shown = e.stored["position"], e.shown["position"] & e.inside
    if np.count_nonzero(shown) < MIN_PAIRS or e.pairs.thin:
        return
    shown = shown.copy()
    shown[1] &= e.pairs.count < 4 * MIN_PAIRS  # neighbours say the same
    columns, rows = e.pairs.columns[shown], e.pairs.rows[shown]
    asked = e.asked.axes.get("position")
    points = stored[:, shown]
    if e.around:
        _around(e, (asked or AS_STORED).of(points), shown)
        return
    found = projection((asked or AS_STORED).of(points), columns, rows, parallel=e.parallel)
    if found is not None:
        _field_of_view(e, found[0][0])
        return
    fitting = [
        axes for axes in EVERY if projection(axes.of(points), columns, rows, parallel=e.parallel)
    ]
    if len(fitting) == 1 and asked is None:
        axes = fitting[0]
        e.read("position", f"stored with other axes; read as {axes}{axes.name}", axes=axes)
        return
    seen = "the positions don't lie on the rays of their pixels, as a camera at 0 sees them"
    if fitting:
        options = [f"--axes position:{axes}" for axes in fitting]
        raise ContradictionError(
            f"{seen}; with the axes {fitting[0]}{fitting[0].name} they would",
            seen=seen,
            fits=[str(axes) for axes in fitting],
            fix=" or ".join(options),
        )
    world = None
    if e.matrix is not None:
        placed = e.matrix[:3, :3] @ points + e.matrix[:3, 3:]
        world = projection(placed, columns, rows)
    if world:
        raise ContradictionError(
            f"{seen}; in world space they would",
            seen=seen,
            fits=["world space"],
            fix="--map position_world=position",
        )
    if projection(points, columns, rows, parallel=True):
        e.parallel = True
        return
    side = float((stored[2, shown] > 0).mean())
    raise ContradictionError(
        f"{seen}: {side:.0%} lie behind it" if side > FEW else seen,
        seen=seen,
        fix="if they are in world space, say so and where the camera is: "
        "--map position_world=<layer> and --world-to-camera <16 numbers>",
    )


def _around(e: Examination, points: Array, shown: Mask) -> None:
    """Whether positions lie where a panorama's pixels look."""
    rays = e.rays[:, shown]
    with np.errstate(all="ignore"):
        cosine = (points * rays).sum(0) / np.sqrt((points * points).sum(0))
    if not np.median(cosine) > 0.99:
        seen = "the positions don't lie where the pixels of a panorama look"
        raise ContradictionError(
            seen, fix="if they are in world space: --map position_world=<layer>, with a matrix"
        )


def _field_of_view(e: Examination, pixel: float) -> None:
    """Whether the camera's field of view is the one that the positions imply."""
    if e.camera is None or e.camera.projection != "perspective":
        return
    wide = pixel * e.camera.pixels_per_unit  # how much wider they are
    if not 0.9 < wide < 1.1:
        half = np.degrees(np.arctan(0.5 * e.camera.width * pixel))
        e.warn(
            f"the positions span {2 * half:.3g}° across the frame, but the field of view is "
            f"{e.camera.fov:.3g}°"
        )
