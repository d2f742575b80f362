"""CMAA2: conservative morphological anti-aliasing, version 2.3.

F. Strugar (Intel), 2018: https://github.com/GameTechDev/CMAA2, `CMAA2.hlsl` (Apache-2.0). Edges are
where luma differs by more than a threshold and a share of the edges that touch it; a pixel with
edges on two adjoining sides is a corner. Corners are blended a little with what lies beyond their
edges. Those that are the step of a Z (an edge that goes on one row further) follow both arms and
blend the pixels along them by how far the silhouette lies from their middle; where several shapes
meet, their weighted mean counts. As there, the few corners are collected first and scatter what
they blend.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.aa.seen import Lit, upload
from deepshade_report.baselines.picture import Filter, Grid, mi, number
from deepshade_report.tuning import Ranges, Tunable, tuned

RIGHT, BELOW, LEFT, ABOVE = 1, 2, 4, 8  # bits of a pixel's edges
LONGEST = 86  # pixels that an arm of a Z is followed for
SIMPLE, LONG = 0.5, 1.5  # how much both kinds of shapes count where they meet
ODD = 0.22  # of a pixel: by how much arms of odd length are shortened
DAMPING = 0.15  # short Zs are blended less: full from 1 / DAMPING pixels on
STRAIGHTER = 0.85  # how much more a corner takes across an edge that goes on

# what edges are found in, and the threshold: the source's presets low, medium, high and ultra
SETTINGS = (
    ("luma", 0.15),
    ("luma", 0.1),
    ("luma", 0.07),
    ("luma", 0.05),
    ("colour", 0.05),
)
QUICK = (SETTINGS[2], SETTINGS[4])


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `threshold` multiplies the setting's. `contrast` is the share of a touching edge's strength that
    an edge must exceed the threshold by. `blur` is how much a corner takes from across an edge.
    """

    threshold: float = 1.0
    contrast: float = 0.1
    blur: float = 0.1


PUBLISHED = Parameters()
RANGES: Ranges = {"threshold": (0.02, 2.0), "contrast": (0.0, 0.5), "blur": (0.0, 0.3)}


def cmaa2(edges: str, threshold: float, parameters: Parameters | None = None) -> Filter:
    """CMAA2 as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "cmaa2"))
    settings = {"edges": edges, "threshold": threshold}
    return Filter("CMAA2", settings, parameters, upload, _shade)


TUNABLE = Tunable(partial(cmaa2, *SETTINGS[3]), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """CMAA2 at its settings, from cheap to best; in a quick report, two of them."""
    return [cmaa2(*setting) for setting in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, kind: str, threshold: float, *given: float) -> Any:
    factor, contrast, blur = given
    bits, is_corner = _detected(lit, kind, number(threshold * factor), number(contrast))
    corners = dr.compress(is_corner)
    return _blended(lit, bits, corners, number(blur)) if dr.width(corners) else lit.light


# Passes are recorded once and replayed: to trace them for each frame takes longer than some do.
@dr.freeze
def _detected(lit: Lit, kind: str, threshold: Any, contrast: Any) -> tuple[Any, Any]:
    """Each pixel's edges, and whether it has a corner."""
    seen = dr.sqrt(dr.clip(lit.light * lit.factor, 0, 1))  # the source's curve
    if kind == "luma":
        seen = _luma(seen)
    dr.eval(seen)
    half = _edges(lit.grid, seen, threshold, contrast)
    dr.eval(half)
    return _all_edges(lit.grid, half)


@dr.freeze
def _blended(lit: Lit, bits: Any, corners: Any, blur: Any) -> Any:
    """The picture, from all edges and the indices of the corners."""
    sums = Sums(lit.grid)
    _blend(Shapes(lit.grid, bits, lit.light), sums, corners, blur)
    return sums.mean(lit.light)


def _luma(colour: Any) -> Any:
    """Luma of an encoded colour (Rec. 601)."""
    return dr.dot(colour, mi.Color3f(0.299, 0.587, 0.114))


def _edges(grid: Grid, seen: Any, threshold: Any, contrast: Any) -> Any:
    """Each pixel's edges to the right and below, as bits."""
    column, row = grid.pixels()
    around = {
        (x, y): dr.gather(type(seen), seen, grid.at(column + x, row + y))
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
        if (x, y) != (-1, -1)
    }

    def step(one: tuple[int, int], two: tuple[int, int]) -> Any:
        apart = dr.abs(around[one] - around[two])
        return apart if isinstance(apart, mi.Float) else _luma(apart)

    def right(x: int, y: int) -> Any:
        return step((x, y), (x + 1, y))

    def below(x: int, y: int) -> Any:
        return step((x, y), (x, y + 1))

    def highest(one: Any, two: Any, three: Any, four: Any) -> Any:
        return dr.maximum(dr.maximum(one, two), dr.maximum(three, four))

    touching = highest(below(0, -1), below(0, 0), below(1, -1), below(1, 0))
    found = dr.select(right(0, 0) - contrast * touching > threshold, mi.UInt32(RIGHT), 0)
    touching = highest(right(-1, 0), right(0, 0), right(-1, 1), right(0, 1))
    found |= dr.select(below(0, 0) - contrast * touching > threshold, mi.UInt32(BELOW), 0)
    return found


def _all_edges(grid: Grid, half: Any) -> tuple[Any, Any]:
    """All four edges of pixels, of those to the right and below, and which have a corner."""
    column, row = grid.pixels()
    # the picture's border is no edge: there a pixel meets itself
    left = dr.gather(mi.UInt32, half, grid.at(column - 1, row)) & RIGHT
    above = dr.gather(mi.UInt32, half, grid.at(column, row - 1)) & BELOW
    bits = half | dr.select(column > 0, left * (LEFT // RIGHT), 0)
    bits |= dr.select(row > 0, above * (ABOVE // BELOW), 0)
    level, upright = bits & (LEFT | RIGHT), bits & (ABOVE | BELOW)
    return bits, (level != 0) & (upright != 0)


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Shapes:
    """Edges and light of a picture."""

    grid: Grid
    bits: Any
    light: Any

    def at(self, column: Any, row: Any) -> Any:
        """A pixel's edges; beyond the picture there are none."""
        inside = (column >= 0) & (row >= 0) & (column < self.grid.width) & (row < self.grid.height)
        return dr.gather(mi.UInt32, self.bits, mi.UInt32(row * self.grid.width + column), inside)

    def seen(self, column: Any, row: Any) -> Any:
        """A pixel's light."""
        return dr.gather(mi.Color3f, self.light, self.grid.at(column, row))


class Sums:
    """What shapes scatter: a weighted colour and the weight, by pixel. No state of a loop."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        size = grid.shape[0] * grid.shape[1]
        self.planes = [dr.zeros(mi.Float, size) for _ in range(4)]
        dr.eval(self.planes)

    def add(self, colour: Any, weight: float, column: Any, row: Any) -> None:
        """Count a colour for a pixel."""
        index = self.grid.at(column, row)
        values = colour.x * weight, colour.y * weight, colour.z * weight, mi.Float(weight)
        for plane, value in zip(self.planes, values, strict=True):
            dr.scatter_add(plane, value, index, mode=dr.ReduceMode.Direct)

    def mean(self, light: Any) -> Any:
        """The mean of what each pixel was given, or else its own light."""
        *colour, weight = self.planes
        return dr.select(weight > 0, mi.Color3f(*colour) / dr.maximum(weight, SIMPLE), light)


def _blend(shapes: Shapes, sums: Sums, corners: Any, blur: Any) -> None:
    """Add what all shapes that start in corners blend."""
    column, row = shapes.grid.coordinates(mi.Int32(corners))
    here = shapes.at(column, row)
    left, right = shapes.at(column - 1, row), shapes.at(column + 1, row)
    above, below = shapes.at(column, row - 1), shapes.at(column, row + 1)

    shares = _corner_shares(here, left, right, above, below, blur)
    colour = shapes.seen(column, row) * (1 - shares[0] - shares[1] - shares[2] - shares[3])
    places = ((1, 0), (0, 1), (-1, 0), (0, -1))
    for share, (x, y) in zip(shares, places, strict=True):
        colour += share * shapes.seen(column + x, row + y)
    sums.add(colour, SIMPLE, column, row)

    level = _scores(here, left, right, shapes.at(column + 2, row))
    turned = (_turned(each) for each in (here, below, above, shapes.at(column, row - 2)))
    upright = _scores(*turned)
    is_level = dr.maximum(*level) >= dr.maximum(*upright)
    normal, inverted = (dr.select(is_level, a, b) for a, b in zip(level, upright, strict=True))
    score = dr.maximum(normal, inverted)
    _follow(shapes, sums, column, row, is_level, inverted > normal, score)
    dr.eval(sums.planes)


def _has(bits: Any, bit: int) -> Any:
    """1 where an edge is, else 0."""
    return dr.select((bits & bit) != 0, mi.Float(1), 0)


def _turned(bits: Any) -> Any:
    """Edges of a picture that is turned by 90 degrees, so that what is above lies to the right."""
    return ((bits << 1) & 15) | (bits >> 3)


def _corner_shares(here: Any, left: Any, right: Any, above: Any, below: Any, blur: Any) -> Any:
    """What a corner takes from the right, below, left and above."""
    sides = RIGHT, BELOW, LEFT, ABOVE
    one = [_has(here, side) for side in sides]
    around = (right, below, left, above)
    count = one[0] + one[1] + one[2] + one[3]
    others = mi.Float(0)
    for k, bits in enumerate(around):
        for side in sides:
            if side != sides[(k + 2) % 4]:  # that is this pixel's own
                others += _has(bits, side)
    is_two = count == 2
    strength = blur * dr.select(is_two, 0.7, 1.0) * dr.clip(1.3 - others / 10, 0, 1)
    shares = []
    for k, side in enumerate(sides):
        # the edge goes on beyond either neighbouring side, and the other edge doesn't
        more = mi.Float(0)
        for ahead in (1, 3):  # the side that has the corner's other edge
            crossing, back = sides[(k + ahead) % 4], around[(k + ahead + 2) % 4]
            ends = 1 - _has(around[(k + 2) % 4], crossing)
            more += one[(k + ahead) % 4] * _has(back, side) * ends
        shares.append(strength * (one[k] + dr.select(is_two, STRAIGHTER * more, 0)))
    return shares


def _scores(here: Any, left: Any, right: Any, next_right: Any) -> tuple[Any, Any]:
    """How well a pixel's right edge is the step of a Z: from above it to below, and inverted."""
    scores = []
    for start, end in ((ABOVE, BELOW), (BELOW, ABOVE)):
        is_z = _has(here, RIGHT) * _has(here, start) * _has(right, end)
        arms = _has(left, start) + _has(next_right, end)
        against = _has(here, end) + _has(right, start)
        blurred = _has(next_right, start) + _has(left, end) + _has(here, LEFT) + _has(right, RIGHT)
        scores.append(is_z * (2 + arms - against - 0.7 * blurred))
    return scores[0], scores[1]


@dr.syntax
def _follow(
    shapes: Shapes, sums: Sums, column: Any, row: Any, is_level: Any, inverted: Any, score: Any
) -> None:
    """Blend along both arms of a Z whose step is the right edge of a pixel (above, if upright)."""
    one_x, one_y = dr.select(is_level, 1, 0), dr.select(is_level, 0, -1)
    before = dr.select(is_level, mi.UInt32(ABOVE), LEFT)
    after = dr.select(is_level, mi.UInt32(BELOW), RIGHT)
    first, second = dr.select(inverted, after, before), dr.select(inverted, before, after)

    left, right = mi.Int32(1), mi.Int32(1)
    goes_left, goes_right = mi.Bool(score > 0), mi.Bool(score > 0)
    running = mi.Bool(score > 0)
    while running:
        goes_left &= (shapes.at(column - one_x * left, row - one_y * left) & first) != 0
        ahead = right + 1
        goes_right &= (shapes.at(column + one_x * ahead, row + one_y * ahead) & second) != 0
        left += dr.select(goes_left, 1, 0)
        right += dr.select(goes_right, 1, 0)
        limit = dr.minimum(1.3 * mi.Float(dr.minimum(left, right)) - 0.3, LONGEST)
        running = (goes_left | goes_right) & (mi.Float(dr.maximum(left, right)) < limit)

    missing = mi.Int32(dr.floor(dr.clip(4 - score, 0, 3)))
    left, right = left - missing, right - missing
    odd_left, odd_right = (ODD * mi.Float(length & 1) for length in (left, right))
    strength = dr.clip(mi.Float(left + right - missing) * DAMPING, 0, 1)
    start, end = 1 - ((left + 1) >> 1), (right + 1) >> 1
    step = 1 / (mi.Float(end - start + 1) - odd_left - odd_right)
    offset = 0.5 - odd_left - mi.Float(start)
    side = dr.select(inverted, 1, -1)  # of the pixels that the first arm is blended with

    k = mi.Int32(start)
    active = (score > 0) & (left + right >= 5)
    while active & (k <= end):
        share = (mi.Float(k) + offset) * step
        share = dr.clip(dr.select(k > 0, 1 - share, share) * strength, 0, 1)
        c, r = column + one_x * k, row + one_y * k
        towards = dr.select(k > 0, -side, side)
        across = dr.select(is_level, 0, towards), dr.select(is_level, towards, 0)
        colour = dr.lerp(shapes.seen(c, r), shapes.seen(c + across[0], r + across[1]), share)
        sums.add(colour, LONG, c, r)
        k += 1
