"""Tiles that compute only what counts, and answer exactly what the whole picture would.

Three kinds of pixels: background (zero in every input), pixels whose answer is known, and those
that the network must answer. A tile computes a rectangle T to answer the rectangle V within it.
Two reaches of the network make the answer the whole picture's:

- nothing farther than `halo` from V counts for V, so T need not leave D = V grown by `halo`;
- background farther than `background_halo` from all geometry changes no geometry. Applied to D
  as a picture of its own, T need not leave the geometry in D grown by `background_halo`.

Known pixels need no answer but are geometry all the same: their neighbours may see them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from deepshade_service.coverage import Box, Grid
from deepshade_service.tiles import Span, Tile, plan_tiles, up

# What one more prediction costs, in pixels: a call, and a copy in and out.
_CALL = 128 * 128
# A tiling has to spare this share to be preferred: a network is slow with a size that is new to it.
_WORTH = 0.08
_PIXELS_A_SPLIT = 200_000  # how hard to look: one more split is tried for so many pixels
_MOST_SPLITS = 15
_TRIED = 3  # cuts of each direction that are priced exactly


@dataclass(frozen=True, slots=True)
class Reach:
    """How a network sees: its size multiple, halo and background halo, all in pixels."""

    multiple: int
    halo: int
    background_halo: int


@dataclass(frozen=True, slots=True)
class Piece:
    """A rectangle of pixels to answer, the one to compute for it, and its price in pixels."""

    valid: Box
    computed: Box
    price: int

    @property
    def tile(self) -> Tile:
        """The same as a tile."""
        (a, b, c, d), (first, last, left, right) = self.computed, self.valid
        return Tile(Span(a, b, first, last), Span(c, d, left, right))


def cover(grid: Grid, reach: Reach, max_pixels: int) -> list[Tile] | None:
    """Few tiles that answer all needed pixels at the least price found; [] if none is needed.

    None if the whole picture, in as many tiles as it takes, is as good. No tile computes more
    than `max_pixels`, but for the smallest sensible ones (`tiles.smallest_tile`).
    """
    if grid.full:
        return None
    fit = _Fit(grid, reach, max_pixels)
    root = fit((0, grid.height, 0, grid.width))
    if root is None:
        return []
    tiles = [tile for piece in _split(fit, root) for tile in _cut(fit, piece)]
    whole = plan_tiles(
        grid.height, grid.width, multiple=reach.multiple, halo=reach.halo, max_pixels=max_pixels
    )
    return tiles if price(tiles) < (1 - _WORTH) * price(list(whole)) else None


def computed_pixels(tiles: Iterable[Tile]) -> int:
    """What the network computes, overlaps and padding included."""
    return sum(tile.shape[0] * tile.shape[1] for tile in tiles)


def price(tiles: list[Tile]) -> int:
    """The same with what the calls cost beside."""
    return computed_pixels(tiles) + _CALL * len(tiles)


class _Fit:
    """From a rectangle of pixels to the piece that answers what is needed in it."""

    def __init__(self, grid: Grid, reach: Reach, max_pixels: int) -> None:
        self.grid = grid
        self.reach = reach
        self.max_pixels = max_pixels
        self._end = up(grid.height, reach.multiple), up(grid.width, reach.multiple)

    def __call__(self, box: Box) -> Piece | None:
        """None if nothing in it needs an answer."""
        grid, reach = self.grid, self.reach
        needed = grid.needed.bounds(grid.touched(box))
        if needed is None:
            return None
        valid = _within(grid.pixels(needed), box)
        seen = _within(_grown(valid, reach.halo), (0, self._end[0], 0, self._end[1]))
        geometry = grid.geometry.bounds(grid.touched(seen))
        assert geometry is not None, "what is needed is geometry"
        tile = _within(_grown(grid.pixels(geometry), reach.background_halo), seen)
        computed = self._aligned(tile)
        return Piece(valid, computed, _area(computed) + _CALL)

    def _aligned(self, box: Box) -> Box:
        """Outwards to the network's cells, and to few different sizes: in steps of our cells."""
        multiple, step = self.reach.multiple, self.grid.cell
        top, bottom = box[0] // multiple * multiple, up(box[1], multiple)
        left, right = box[2] // multiple * multiple, up(box[3], multiple)
        even = (
            *_stepped(top, bottom, step, self._end[0]),
            *_stepped(left, right, step, self._end[1]),
        )
        return even if _area(even) <= self.max_pixels else (top, bottom, left, right)


def _stepped(low: int, high: int, step: int, end: int) -> tuple[int, int]:
    """A span around [low, high) whose size is a multiple of `step`, or all of [0, end)."""
    size = min(up(high - low, step), end)
    high = min(low + size, end)
    return high - size, high


def _split(fit: _Fit, root: Piece) -> list[Piece]:
    """Cuts the emptiest piece in two as long as that pays: a guillotine, greedily."""
    grid = fit.grid
    splits = min(_MOST_SPLITS, 1 + grid.height * grid.width // _PIXELS_A_SPLIT)
    least = _WORTH / 2 * _area(root.computed)  # that a split may save at best, to be tried
    done: list[Piece] = []
    open_ = [(_empty(grid, root), root)]
    for _ in range(splits):
        open_.sort(key=lambda entry: entry[0])
        if not open_ or open_[-1][0] <= least:
            break
        _, piece = open_.pop()
        pieces = _best_cut(fit, piece)
        if pieces is None:
            done.append(piece)
        else:
            open_ += [(_empty(grid, part), part) for part in pieces]
    return done + [piece for _, piece in open_]


def _empty(grid: Grid, piece: Piece) -> int:
    """Pixels that a piece answers without need: only they can be saved by cutting it."""
    cells = grid.touched(piece.valid)
    return (_area(cells) - grid.needed.count(cells)) * grid.cell**2


def _best_cut(fit: _Fit, piece: Piece) -> list[Piece] | None:
    """The two pieces of the cheapest cut between cells, if they cost less than the one."""
    grid = fit.grid
    cells = top, bottom, left, right = grid.touched(piece.valid)
    margin = 2 * fit.reach.background_halo / grid.cell
    best, pieces = piece.price, None
    rows = _promising(grid.needed.rows, top, bottom, left, right, margin)
    columns = _promising(grid.needed.columns, left, right, top, bottom, margin)
    for axis, at in [(0, at) for at in rows] + [(2, at) for at in columns]:
        low, high = list(cells), list(cells)
        low[axis + 1] = high[axis] = at
        parts = [
            part
            for box in (low, high)
            if (part := fit(_within(grid.pixels((box[0], box[1], box[2], box[3])), piece.valid)))
        ]
        if sum(part.price for part in parts) < best:
            best, pieces = sum(part.price for part in parts), parts
    return pieces


def _promising(
    lines: list[int], first: int, last: int, low: int, high: int, margin: float
) -> list[int]:
    """The cuts between lines that leave the smallest boxes, were there no overlap of the two."""
    inside = ((1 << (high - low)) - 1) << low

    def boxes(order: Iterable[int]) -> list[float]:
        sizes, seen, begin = [], 0, None
        for count, at in enumerate(order, 1):
            line = lines[at] & inside
            if line:
                begin = count if begin is None else begin
                end, seen = count, seen | line
            if begin is None:
                sizes.append(0.0)
            else:
                width = seen.bit_length() - (seen & -seen).bit_length() + 1
                sizes.append((end - begin + 1 + margin) * (width + margin))
        return sizes

    before, after = boxes(range(first, last)), boxes(range(last - 1, first - 1, -1))
    cuts = range(first + 1, last)
    return sorted(cuts, key=lambda at: before[at - first - 1] + after[last - at - 1])[:_TRIED]


def _cut(fit: _Fit, piece: Piece) -> list[Tile]:
    """One piece as tiles that are small enough, without those that answer nothing."""
    top, bottom, left, right = piece.computed
    if _area(piece.computed) <= fit.max_pixels:
        return [piece.tile]
    tiling = plan_tiles(
        bottom - top,
        right - left,
        multiple=fit.reach.multiple,
        halo=fit.reach.halo,
        max_pixels=fit.max_pixels,
    )
    tiles = []
    for tile in tiling:
        rows, columns = tile.rows, tile.columns
        box = (top + rows.first, top + rows.last, left + columns.first, left + columns.last)
        box = _within(box, piece.valid)
        if box[0] < box[1] and box[2] < box[3] and (part := fit(box)):
            tiles.append(part.tile)
    return tiles


def _within(box: Box, other: Box) -> Box:
    return (
        max(box[0], other[0]),
        min(box[1], other[1]),
        max(box[2], other[2]),
        min(box[3], other[3]),
    )


def _grown(box: Box, by: int) -> Box:
    return box[0] - by, box[1] + by, box[2] - by, box[3] + by


def _area(box: Box) -> int:
    return (box[1] - box[0]) * (box[3] - box[2])
