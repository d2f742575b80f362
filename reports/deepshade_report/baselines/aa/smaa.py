"""SMAA 1x: enhanced subpixel morphological anti-aliasing.

J. Jimenez, J. I. Echevarria, T. Sousa, D. Gutierrez: "SMAA: Enhanced Subpixel Morphological
Antialiasing", Eurographics 2012, and the authors' `SMAA.hlsl` (MIT licence): edges with local
contrast adaptation (section 3.1), search of lines' ends and crossing edges, for diagonals first
(3.2), sharp corners kept, and blending across edges by the areas that the true silhouette cuts off
pixels. The areas are calculated (`areas`), and searches go pixel by pixel, so that no texture is
needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.aa.areas import DIAGONAL, diagonal_areas, line_areas
from deepshade_report.baselines.aa.seen import Lit, encoded, luma, upload
from deepshade_report.baselines.picture import Filter, Grid, mi, number
from deepshade_report.tuning import Ranges, Tunable, tuned

WEST, NORTH = 1, 2  # bits of a pixel's edges

# what edges are found in; threshold, pixels that a search goes, and along diagonals: the source's
# presets low, medium, high and ultra, and depth
SETTINGS = (
    ("depth", 0.01, 64, 16),
    ("luma", 0.15, 8, 0),
    ("luma", 0.1, 16, 0),
    ("luma", 0.1, 32, 8),
    ("luma", 0.05, 64, 16),
    ("colour", 0.05, 64, 16),
)
QUICK = (SETTINGS[2], SETTINGS[4])


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `threshold` multiplies the setting's. `contrast` is how many times as strong an edge near by
    may be. `rounding` in [0, 1] is how much corners are rounded.
    """

    threshold: float = 1.0
    contrast: float = 2.0
    rounding: float = 0.25


PUBLISHED = Parameters()
RANGES: Ranges = {"threshold": (0.2, 2.0), "contrast": (1.2, 6.0), "rounding": (0.0, 1.0)}


def smaa(
    edges: str, threshold: float, steps: int, diagonal: int, parameters: Parameters | None = None
) -> Filter:
    """SMAA as a Method, with the parameters that were tuned or those given."""
    settings = {"edges": edges, "threshold": threshold, "steps": steps, "diagonal": diagonal}
    parameters = parameters or Parameters(**tuned(__package__, "smaa"))
    return Filter("SMAA", settings, parameters, upload, _shade)


TUNABLE = Tunable(partial(smaa, *SETTINGS[4]), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """SMAA at its settings, from cheap to best; in a quick report, two of them."""
    return [smaa(*setting) for setting in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, kind: str, threshold: float, steps: int, diagonal: int, *given: float) -> Any:
    factor, contrast, rounding = given
    edges = _detected(lit, kind, number(threshold * factor), number(contrast))
    where = dr.compress(edges != 0)
    if not dr.width(where):
        return lit.light
    counts = dr.opaque(mi.Int32, steps), dr.opaque(mi.Int32, diagonal)
    return _blended(lit, edges, where, diagonal_areas(), *counts, number(1 - rounding))


# Passes are recorded once and replayed: to trace them for each frame took a fifth of the time.
@dr.freeze
def _detected(lit: Lit, kind: str, threshold: Any, contrast: Any) -> Any:
    """Each pixel's edges to the left and above, WEST and NORTH."""
    if kind == "depth":
        return _depth_edges(lit, threshold)
    seen = encoded(lit)
    if kind == "luma":
        seen = luma(seen)
    dr.eval(seen)
    return _edges(lit.grid, seen, threshold, contrast)


@dr.freeze
def _blended(
    lit: Lit, edges: Any, where: Any, table: Any, steps: Any, diagonal: Any, keep: Any
) -> Any:
    """The picture, from edges and the indices of the pixels that have any."""
    place = lit.grid.coordinates(mi.Int32(where))
    found = _weights(Edges(lit.grid, edges), table, *place, steps, diagonal, keep)
    weights = dr.zeros(mi.Vector4f, dr.width(edges))
    dr.scatter(weights, found, where)
    dr.eval(weights)
    return _blend(lit, weights)


def _edges(grid: Grid, seen: Any, threshold: Any, contrast: Any) -> Any:
    """Each pixel's edges to the left and above, WEST and NORTH."""
    column, row = grid.pixels()
    kind = type(seen)

    def at(right: int, down: int) -> Any:
        return dr.gather(kind, seen, grid.at(column + right, row + down))

    def step(one: Any, two: Any) -> Any:
        apart = dr.abs(one - two)
        return apart if kind is mi.Float else dr.max(apart)

    here, left, above = at(0, 0), at(-1, 0), at(0, -1)
    west, north = step(here, left), step(here, above)
    strongest = dr.maximum(west, north)
    for one, two in ((here, at(1, 0)), (here, at(0, 1)), (left, at(-2, 0)), (above, at(0, -2))):
        strongest = dr.maximum(strongest, step(one, two))
    found = mi.UInt32(0)
    for bit, strength in ((WEST, west), (NORTH, north)):
        is_edge = (strength >= threshold) & (strongest <= contrast * strength)
        found |= dr.select(is_edge, mi.UInt32(bit), 0)
    return found


def _depth_edges(lit: Lit, threshold: Any) -> Any:
    """The same of depth: differences relative to it, so that a scene's scale changes nothing."""
    column, row = lit.grid.pixels()
    here = lit.nearness
    found = mi.UInt32(0)
    for bit, right, down in ((WEST, -1, 0), (NORTH, 0, -1)):
        other = dr.gather(mi.Float, lit.nearness, lit.grid.at(column + right, row + down))
        apart = dr.abs(here - other) > 10 * threshold * dr.minimum(here, other)
        found |= dr.select(apart, mi.UInt32(bit), 0)
    return found


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Edges:
    """The picture's edges; beyond it there are none."""

    grid: Grid
    bits: Any

    def at(self, column: Any, row: Any, bit: int) -> Any:
        """Whether a pixel has an edge."""
        inside = (column >= 0) & (row >= 0) & (column < self.grid.width) & (row < self.grid.height)
        index = mi.UInt32(row * self.grid.width + column)
        return (dr.gather(mi.UInt32, self.bits, index, inside) & bit) != 0


def _weights(
    edges: Edges, table: Any, column: Any, row: Any, steps: Any, diagonal: Any, keep: Any
) -> Any:
    """How much of the pixels across it an edge blends: NORTH's to this and above, WEST's alike."""
    north, west = (edges.at(column, row, bit) for bit in (NORTH, WEST))
    slanted = _diagonals(edges, table, column, row, north & (diagonal > 0), west, diagonal)
    found = slanted[0] + slanted[1] > 0
    lines = _line(edges, column, row, north & ~found, steps, keep, False)
    upright = _line(edges, column, row, west & ~(north & found), steps, keep, True)
    return mi.Vector4f(slanted[0] + lines[0], slanted[1] + lines[1], *upright)


@dr.syntax
def _search(
    edges: Edges, column: Any, row: Any, active: Any, steps: Any, way: int, upright: bool
) -> Any:
    """Pixels that a line goes on for, to the left (-1) or right: up or down where `upright`."""
    along, crossing = (WEST, NORTH) if dr.hint(upright, mode="scalar") else (NORTH, WEST)
    right, down = (0, 1) if dr.hint(upright, mode="scalar") else (1, 0)
    length = mi.Int32(0)
    running = mi.Bool(active)
    while running:
        c, r = column + right * way * (length + 1), row + down * way * (length + 1)
        # the boundary that is met next is the near side of the next pixel, going right
        back = 1 if dr.hint(way < 0, mode="scalar") else 0
        b, t = c + right * back, r + down * back
        crossed = edges.at(b, t, crossing) | edges.at(b - down, t - right, crossing)
        running = edges.at(c, r, along) & ~crossed
        length = dr.select(running, length + 1, length)
        running &= length < steps
    return length


def _line(
    edges: Edges, column: Any, row: Any, active: Any, steps: Any, keep: Any, upright: bool
) -> tuple[Any, Any]:
    """Areas to both sides of a line: of this pixel and of that above (upright: to the left)."""
    crossing = NORTH if upright else WEST

    def at(forth: Any, side: int, bit: int) -> Any:
        shift = (side, forth) if upright else (forth, side)
        return edges.at(column + shift[0], row + shift[1], bit)

    left, right = (_search(edges, column, row, active, steps, way, upright) for way in (-1, 1))
    ends = [(at(border, 0, crossing), at(border, -1, crossing)) for border in (-left, right + 1)]
    here, above = line_areas(mi.Float(left), mi.Float(right), *ends)

    # corners: where the line's end goes on into a longer edge, blend less of it
    nearest = [dr.select(one <= two, 1.0, 0.0) for one, two in ((left, right), (right, left))]
    shares = [keep * one / (nearest[0] + nearest[1]) for one in nearest]
    for side, is_here in ((1, True), (-2, False)):
        corner = mi.Float(1)
        for share, border in zip(shares, (-left, right + 1), strict=True):
            corner -= dr.select(at(border, side, crossing), share, 0)
        corner = dr.clip(corner, 0, 1)
        if is_here:
            here *= corner
        else:
            above *= corner
    return dr.select(active, here, 0), dr.select(active, above, 0)


@dr.syntax
def _run(
    edges: Edges, column: Any, row: Any, active: Any, limit: Any, right: int, down: int
) -> tuple[Any, Any, Any]:
    """Pixels that a diagonal goes on for, whether it ends there, and the end's upper edge.

    Rising diagonals have both edges in a pixel, falling ones the left edge in the next.
    """
    shift = int(right == down)
    length = mi.Int32(-1)
    running = mi.Bool(active)
    upper, goes_on = mi.Bool(False), mi.Bool(False)
    while running:
        length += 1
        c, r = column + right * (length + 1), row + down * (length + 1)
        upper = edges.at(c, r, NORTH)
        goes_on = upper & edges.at(c + shift, r, WEST)
        running = goes_on & (length < limit - 1)
    return dr.select(active, length, 0), ~goes_on, upper


def _diagonals(
    edges: Edges, table: Any, column: Any, row: Any, active: Any, west: Any, limit: Any
) -> tuple[Any, Any]:
    """Areas of this pixel and of that above, along both diagonals through it."""

    def at(right: Any, down: Any, bit: int) -> Any:
        return dr.select(edges.at(column + right, row + down, bit), 1, 0)

    def areas(left: Any, right: Any, one: Any, two: Any) -> tuple[Any, Any]:
        is_long = active & (left + right > 2)
        index = ((one * 4 + two) * DIAGONAL + left) * DIAGONAL + right
        found = dr.gather(mi.Vector2f, table, mi.UInt32(index), is_long)
        return found.x, found.y

    left, ended, upper = _run(edges, column, row, active & west, limit, -1, 1)
    left += dr.select(west & upper, 1, 0)
    right, stopped, _ = _run(edges, column, row, active, limit, 1, -1)
    one = 2 * at(-left - 1, left, NORTH) + at(-left, left, WEST)
    two = 2 * at(right + 1, -right, NORTH) + at(right + 1, -right - 1, WEST)
    here, above = areas(left, right, dr.select(ended, one, 0), dr.select(stopped, two, 0))

    left, ended, _ = _run(edges, column, row, active, limit, -1, -1)
    next_west = edges.at(column + 1, row, WEST)
    right, stopped, upper = _run(edges, column, row, active & next_west, limit, 1, 1)
    right += dr.select(next_west & upper, 1, 0)
    one = 2 * at(-left - 1, -left, NORTH) + at(-left, -left - 1, WEST)
    two = 2 * at(right + 1, right, NORTH) + at(right + 1, right, WEST)
    more = areas(left, right, dr.select(ended, one, 0), dr.select(stopped, two, 0))
    return here + more[1], above + more[0]


def _blend(lit: Lit, weights: Any) -> Any:
    """Light of each pixel with that across its stronger pair of edges."""
    grid = lit.grid
    column, row = grid.pixels()
    east = dr.gather(mi.Float, weights.w, grid.at(column + 1, row))
    south = dr.gather(mi.Float, weights.y, grid.at(column, row + 1))
    east, south = (
        dr.select(column + 1 < grid.width, east, 0),
        dr.select(row + 1 < grid.height, south, 0),
    )
    level = dr.maximum(east, weights.z) > dr.maximum(south, weights.x)
    after, before = dr.select(level, east, south), dr.select(level, weights.z, weights.x)
    step_x, step_y = dr.select(level, 1, 0), dr.select(level, 0, 1)
    following = dr.gather(mi.Color3f, lit.light, grid.at(column + step_x, row + step_y))
    preceding = dr.gather(mi.Color3f, lit.light, grid.at(column - step_x, row - step_y))
    total = dr.maximum(after + before, 1e-12)
    blended = dr.lerp(lit.light, following, after) * after
    blended += dr.lerp(lit.light, preceding, before) * before
    return dr.select(after + before > 1e-5, blended / total, lit.light)
