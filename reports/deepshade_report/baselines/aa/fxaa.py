"""FXAA 3.11.

T. Lottes: "FXAA", NVIDIA white paper, 2009, and `Fxaa3_11.h` (2011), the quality version for PC: a
pixel of enough local contrast follows the edge on its stronger side to both ends, and blends with
the pixel across by how near the nearer end is, or by how much it stands out by itself. The presets
are those of the source: 12 is its default, 29 its best of low dither, 39 its extreme one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import accumulate
from typing import Any

import drjit as dr

from deepshade_report.baselines.aa.seen import Lit, encoded, luma, upload
from deepshade_report.baselines.picture import Filter, Grid, mi, number
from deepshade_report.tuning import Ranges, Tunable, tuned

# by preset, the steps in pixels that a search goes
STEPS = {
    12: (1, 1.5, 2, 4, 12),
    29: (1, 1.5, *[2] * 8, 4, 8),
    39: (*[1] * 5, 1.5, *[2] * 4, 4, 8),
}
SETTINGS = (12, 29, 39)  # from cheap to best
QUICK = (12, 39)


@dataclass(frozen=True)
class Parameters:
    """What can be tuned: the source's subpixel amount, and its relative and absolute threshold."""

    subpixel: float = 0.75
    threshold: float = 0.166
    darkest: float = 0.0833


PUBLISHED = Parameters()
RANGES: Ranges = {
    "subpixel": (0.0, 1.0),
    "threshold": (0.005, 0.333),
    "darkest": (0.0, 0.0833),
}


def fxaa(preset: int, parameters: Parameters | None = None) -> Filter:
    """FXAA as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "fxaa"))
    return Filter("FXAA", {"preset": preset}, parameters, upload, _shade)


TUNABLE = Tunable(partial(fxaa, 29), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """FXAA at its settings, from cheap to best; in a quick report, two of them."""
    return [fxaa(preset) for preset in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, preset: int, *given: float) -> Any:
    count = dr.opaque(mi.UInt32, len(STEPS[preset]))
    return _filtered(lit, _reached(preset), count, *(number(value) for value in given))


@lru_cache
def _reached(preset: int) -> Any:
    """On the device, how far a search has gone after each step."""
    return mi.Float([float(place) for place in accumulate(STEPS[preset])])


# Recorded once and replayed: to trace it for each frame took a tenth of the time.
@dr.freeze
def _filtered(lit: Lit, reached: Any, count: Any, *given: Any) -> Any:
    seen = luma(encoded(lit))
    dr.eval(seen)
    return _filter(lit, seen, reached, count, *given)


@dr.syntax
def _filter(
    lit: Lit, seen: Any, reached: Any, count: Any, subpixel: Any, threshold: Any, darkest: Any
) -> Any:
    grid = lit.grid
    column, row = grid.pixels()

    nw, n, ne, w, m, e, sw, s, se = _around(grid, seen, column, row)
    highest = dr.maximum(dr.maximum(dr.maximum(n, s), dr.maximum(w, e)), m)
    lowest = dr.minimum(dr.minimum(dr.minimum(n, s), dr.minimum(w, e)), m)
    contrast = highest - lowest
    active = contrast >= dr.maximum(darkest, highest * threshold)
    active &= contrast > 0

    level = dr.abs(nw + sw - 2 * w) + 2 * dr.abs(n + s - 2 * m) + dr.abs(ne + se - 2 * e)
    upright = dr.abs(nw + ne - 2 * n) + 2 * dr.abs(w + e - 2 * m) + dr.abs(sw + se - 2 * s)
    across = level >= upright  # the edge runs along the row
    mean = (2 * (n + s + w + e) + nw + ne + sw + se) / 12
    alone = dr.clip(dr.abs(mean - m) / dr.maximum(contrast, 1e-6), 0, 1)
    smooth = (3 - 2 * alone) * alone * alone
    least = smooth * smooth * subpixel

    first, second = dr.select(across, n, w), dr.select(across, s, e)
    before = dr.abs(first - m) >= dr.abs(second - m)  # the stronger side: above, or left
    slope = 0.25 * dr.maximum(dr.abs(first - m), dr.abs(second - m))
    middle = 0.5 * (m + dr.select(before, first, second))
    side = dr.select(before, -0.5, 0.5)
    x = mi.Float(column) + dr.select(across, 0, side)
    y = mi.Float(row) + dr.select(across, side, 0)
    along_x, along_y = dr.select(across, 1.0, 0.0), dr.select(across, 0.0, 1.0)

    ends, distances = [], []
    for way in (-1, 1):  # unrolled
        index = mi.UInt32(0)
        distance = dr.gather(mi.Float, reached, index)
        change = mi.Float(0)
        running = mi.Bool(active)
        while running:
            there = distance * way
            change = _between(grid, seen, x + along_x * there, y + along_y * there) - middle
            index += 1
            running = dr.abs(change) < slope
            distance = dr.select(running, dr.gather(mi.Float, reached, index), distance)
            running &= index < count - 1
        ends.append(change)
        distances.append(distance)

    nearer = distances[0] < distances[1]
    end = dr.select(nearer, ends[0], ends[1])
    good = (end < 0) != (m - middle < 0)
    share = 0.5 - dr.minimum(distances[0], distances[1]) / (distances[0] + distances[1])
    share = dr.maximum(dr.select(good, share, 0), least)
    step = mi.Int32(2 * side)
    there = grid.at(column + dr.select(across, 0, step), row + dr.select(across, step, 0))
    blended = dr.lerp(lit.light, dr.gather(mi.Color3f, lit.light, there), share)
    return dr.select(active, blended, lit.light)


def _around(grid: Grid, seen: Any, column: Any, row: Any) -> list[Any]:
    """Luma of each pixel and its neighbours, row by row."""
    places = [(right, down) for down in (-1, 0, 1) for right in (-1, 0, 1)]
    return [dr.gather(mi.Float, seen, grid.at(column + x, row + y)) for x, y in places]


def _between(grid: Grid, seen: Any, x: Any, y: Any) -> Any:
    """Luma between the four pixels around a place, which counts from pixels' centres."""
    left, top = dr.floor(x), dr.floor(y)
    c, r = mi.Int32(left), mi.Int32(top)
    a, b, d, e = (
        dr.gather(mi.Float, seen, grid.at(c + right, r + down))
        for down in (0, 1)
        for right in (0, 1)
    )
    return dr.lerp(dr.lerp(a, b, x - left), dr.lerp(d, e, x - left), y - top)
