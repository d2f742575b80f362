"""McGuire's reconstruction filter for motion blur.

M. McGuire, P. Hennessy, M. Bukowski, B. Osman: "A Reconstruction Filter for Plausible Motion
Blur", I3D 2012, section 2.3 and listing 1. A pixel gathers along the dominant motion about it.
A sample counts as blurred foreground that covers the pixel, as background that the pixel's own
blur uncovers, or as blurred along with it, by cones and cylinders around either's spread and a
soft comparison of depths. The weights' sum normalises the result.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.mb.tiles import STILL, Moving, dominant, nearer, upload
from deepshade_report.baselines.picture import Filter, gradient_noise, mi
from deepshade_report.tuning import Ranges, Tunable, tuned

SETTINGS = (7, 11, 15, 25, 35)  # taps, from cheap to best; the paper's is 15
QUICK = (11, 25)


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `extent` is the relative difference of depths over which nearer fades to farther. `centre`
    multiplies the pixel's own weight. `jitter` is the share of a step over which taps are shifted
    at random. `tile` is the width of tiles, in pixels: spreads (half of a motion) are cut to it.
    """

    extent: float = 0.0625
    centre: float = 1.0
    jitter: float = 1.0
    tile: int = 32


PUBLISHED = Parameters()
RANGES: Ranges = {
    "extent": (0.002, 0.2),
    "centre": (0.1, 4.0),
    "jitter": (0.0, 1.0),
    "tile": (16, 64),
}


def mcguire(taps: int, parameters: Parameters | None = None) -> Filter:
    """The filter as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "mcguire"))
    return Filter("McGuire", {"taps": taps}, parameters, upload, _shade, recorded=True)


TUNABLE = Tunable(partial(mcguire, 15), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The filter at its settings, from cheap to best; in a quick report, two of them."""
    return [mcguire(taps) for taps in (QUICK if quick else SETTINGS)]


def _shade(frame: Moving, taps: int, extent: float, centre: float, jitter: float, tile: int) -> Any:
    numbers = [dr.opaque(mi.Float, value) for value in (tile, extent, centre, jitter)]
    return _gather(frame, dominant(frame, tile), dr.opaque(mi.Int32, taps), *numbers)


@dr.syntax
def _gather(
    frame: Moving, about: Any, taps: Any, tile: Any, extent: Any, centre: Any, jitter: Any
) -> Any:
    u, v, speeds, tiles = about
    column, row = frame.grid.pixels()
    place = tiles.at(mi.Int32(mi.Float(column) / tile), mi.Int32(mi.Float(row) / tile))
    right, down, reach = (dr.gather(mi.Float, plane, place) for plane in (u, v, speeds))
    moving = reach > STILL

    spread, depth = dr.clip(frame.speed, STILL, tile), frame.depth
    weights = centre / spread
    total = frame.light * weights
    offset = (gradient_noise(column, row) - 0.5) * jitter
    tap = mi.Int32(0)
    while (tap < taps) & moving:
        t = dr.fma(2 / mi.Float(taps), mi.Float(tap) + 0.5 + offset, -1)
        c = mi.Int32(dr.round(dr.fma(t, right, mi.Float(column))))
        r = mi.Int32(dr.round(dr.fma(t, down, mi.Float(row))))
        there = frame.grid.at(c, r)
        other = dr.clip(dr.gather(mi.Float, frame.speed, there), STILL, tile)
        far = dr.gather(mi.Float, frame.depth, there)
        distance = dr.abs(t) * reach
        weight = nearer(far, depth, extent) * _cone(distance, other)
        weight += nearer(depth, far, extent) * _cone(distance, spread)
        weight += 2 * _cylinder(distance, other) * _cylinder(distance, spread)
        total += dr.gather(mi.Color3f, frame.light, there) * weight
        weights += weight
        tap += 1
    return dr.select(moving, total / weights, frame.light)


def _cone(distance: Any, spread: Any) -> Any:
    return dr.clip(1 - distance / spread, 0, 1)


def _cylinder(distance: Any, spread: Any) -> Any:
    step = dr.clip((distance / spread - 0.95) * 10, 0, 1)
    return 1 - step * step * (3 - 2 * step)
