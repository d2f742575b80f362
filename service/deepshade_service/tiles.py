"""A grid of equal, overlapping tiles: memory is bounded, and the answer is the whole picture's.

A network that sees `halo` pixels around each pixel gives the same answer for a tile as for the
whole picture, if the tile carries that many pixels of its neighbours. Two details make "same"
exact rather than nearly: every tile starts on a multiple of the network's coarsest cell (else the
pooling windows fall differently), and the last one ends where the padded picture ends (else the
network's own zero padding would start elsewhere).

All tiles of a picture have one size, and there are few sizes, because engines compile each.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from math import prod

from deepshade.tensors import up

MIN_SIDE = 64


@dataclass(frozen=True, slots=True)
class Span:
    """One axis of a tile: computed over [start, stop), valid for [first, last), in pixels."""

    start: int
    stop: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Tile:
    """A rectangle that is computed (`rows`/`columns` start to stop) and its valid inside."""

    rows: Span
    columns: Span

    @property
    def box(self) -> tuple[int, int, int, int]:
        """What is computed: top, bottom, left, right."""
        return self.rows.start, self.rows.stop, self.columns.start, self.columns.stop

    @property
    def answered(self) -> tuple[slice, slice]:
        """The part of the picture that it answers."""
        rows, columns = self.rows, self.columns
        return slice(rows.first, rows.last), slice(columns.first, columns.last)

    @property
    def inner(self) -> tuple[slice, slice]:
        """The same as a part of the tile."""
        return tuple(  # type: ignore[return-value]
            slice(span.first - span.start, span.last - span.start)
            for span in (self.rows, self.columns)
        )


@dataclass(frozen=True, slots=True)
class Grid:
    """Spans of rows and of columns; every combination of two is a tile, all computed at `shape`."""

    rows: tuple[Span, ...]
    columns: tuple[Span, ...]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.rows) * len(self.columns)

    def __iter__(self) -> Iterator[Tile]:
        return (Tile(rows, columns) for rows, columns in product(self.rows, self.columns))

    @property
    def computed(self) -> int:
        """Pixels that the network computes, overlaps and padding included."""
        return len(self) * prod(self.shape)


def plan_tiles(height: int, width: int, multiple: int, halo: int, max_pixels: int) -> Grid:
    """One tile if the padded picture has at most `max_pixels`, else the grid of such tiles that
    computes the fewest pixels.

    `multiple` is the network's size multiple and `halo` its reach, both in pixels. Where even
    the smallest sensible tiles (`min_tile`) exceed `max_pixels`, it is a grid of those.
    """
    halo = up(halo, multiple)
    best = padded(height, width, multiple)
    if prod(best) > max_pixels:
        tall, wide = (_costs(length, multiple, halo) for length in (height, width))
        shapes = [(h, w) for w in wide for h in tall if h * w <= max_pixels]
        shapes = shapes or [(min(tall), min(wide))]
        best = min(shapes, key=lambda shape: tall[shape[0]] * wide[shape[1]])
    rows, columns = (
        _spans(length, side, multiple, halo)
        for length, side in zip((height, width), best, strict=True)
    )
    return Grid(rows, columns, best)


def min_tile(height: int, width: int, multiple: int, halo: int) -> int:
    """Pixels of the smallest sensible tile: as wide inside as its two halos together.

    Three quarters of it are overlap. With still smaller tiles the work explodes: with a halo of
    256 and tiles that are valid in 64 x 64, each pixel would be computed 81 times.
    """
    halo = up(halo, multiple)
    return prod(min(_costs(length, multiple, halo)) for length in (height, width))


def padded(height: int, width: int, multiple: int) -> tuple[int, int]:
    """The size at which a whole picture is computed."""
    return _side(height, multiple), _side(width, multiple)


def _side(length: int, multiple: int) -> int:
    """The least computed side for so many pixels: 64, 128, 256, or a multiple of 64 beyond.

    With a size multiple that divides no 64: the same of the least multiple of it from 64 on.
    """
    step = up(MIN_SIDE, multiple)
    steps = math.ceil(length / step)
    return step * (steps if steps != 3 else 4)


def _costs(length: int, multiple: int, halo: int) -> dict[int, int]:
    """The sides that a tile may have along `length`, largest first, and what all tiles add to."""
    end = _side(length, multiple)
    least = _side(4 * halo or 1, multiple)
    step = up(MIN_SIDE, multiple)
    smaller = (side for side in range(end - step, least - 1, -step) if side != 3 * step)
    return {side: side * len(_spans(length, side, multiple, halo)) for side in (end, *smaller)}


def _spans(length: int, side: int, multiple: int, halo: int) -> tuple[Span, ...]:
    """Spans of one size that cover [0, length); neighbours share two halos.

    A last one that would pass the end of the padded picture is shifted back to end there.
    """
    end = _side(length, multiple)
    spans: list[Span] = []
    start = first = 0
    while first < length:
        stop = start + side
        last = length if stop == end else min(stop - halo, length)
        spans.append(Span(start, stop, first, last))
        start, first = min(stop - 2 * halo, end - side), last
    return tuple(spans)
