"""Cutting a picture into overlapping tiles, so that memory is bounded and the answer the same.

A network that sees `halo` pixels around each pixel gives the same answer for a tile as for the
whole picture, if the tile carries that many pixels of its neighbours. Two details make "same"
exact rather than nearly: every tile starts on a multiple of the network's coarsest cell (else the
pooling windows fall differently), and tiles at the picture's edge end where the padded picture
ends (else the network's own zero padding would start elsewhere).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass


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
    def shape(self) -> tuple[int, int]:
        """Computed (height, width)."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start


@dataclass(frozen=True, slots=True)
class Tiling:
    """A picture cut into `rows` x `columns` spans; every combination of two is a tile."""

    rows: tuple[Span, ...]
    columns: tuple[Span, ...]

    def __len__(self) -> int:
        return len(self.rows) * len(self.columns)

    def __iter__(self) -> Iterator[Tile]:
        return (Tile(rows, columns) for rows in self.rows for columns in self.columns)


def plan_tiles(height: int, width: int, *, multiple: int, halo: int, max_pixels: int) -> Tiling:
    """The tiling with the fewest computed pixels whose tiles have at most `max_pixels`.

    `multiple` is the network's size multiple and `halo` its reach, both in pixels. Tiles of
    `smallest_tile` are used even if they exceed `max_pixels`.
    """
    halo = up(halo, multiple)
    best: tuple[int, int, int] | None = None  # pixels computed, rows, columns
    for across in range(1, math.ceil(width / multiple) + 1):
        widest, columns = _sizes(width, across, multiple, halo)
        if best is not None and columns * up(height, multiple) >= best[0]:
            break  # more columns only add overlap
        down = _fewest_cuts(height, multiple, halo, max_pixels // widest)
        if down is not None:
            computed = columns * _sizes(height, down, multiple, halo)[1]
            if best is None or computed < best[0]:
                best = computed, down, across
    if best is None:
        step = _least(multiple, halo)
        best = 0, math.ceil(height / step), math.ceil(width / step)
    return Tiling(_cut(height, best[1], multiple, halo), _cut(width, best[2], multiple, halo))


def smallest_tile(height: int, width: int, *, multiple: int, halo: int) -> int:
    """Pixels of the smallest sensible tile: as wide inside as its two halos together.

    Three quarters of it are overlap. With still smaller tiles the work explodes: with a halo of
    256 and tiles that are valid in 64 x 64, each pixel would be computed 81 times.
    """
    halo = up(halo, multiple)
    side = _least(multiple, halo) + 2 * halo
    return min(up(height, multiple), side) * min(up(width, multiple), side)


def padded(height: int, width: int, multiple: int) -> tuple[int, int]:
    """The size rounded up to the network's multiple."""
    return up(height, multiple), up(width, multiple)


def _cut(length: int, count: int, multiple: int, halo: int) -> tuple[Span, ...]:
    """About `count` equal spans of whole cells that cover `length` pixels."""
    end = up(length, multiple)
    step = up(math.ceil(end / count), multiple)
    return tuple(
        Span(max(0, at - halo), min(end, at + step + halo), at, min(length, at + step))
        for at in range(0, end, step)
    )


def _sizes(length: int, count: int, multiple: int, halo: int) -> tuple[int, int]:
    """(pixels of the largest span, sum of all) of `_cut`, or more if the halos exceed the spans."""
    end = up(length, multiple)
    step = up(math.ceil(end / count), multiple)
    count = math.ceil(end / step)
    return min(end, step + min(2, count - 1) * halo), end + 2 * halo * (count - 1)


def _fewest_cuts(length: int, multiple: int, halo: int, longest: int) -> int | None:
    """The fewest cuts after which no span is computed over more than `longest` pixels."""
    if up(length, multiple) <= longest:
        return 1
    # Two spans share one inner edge, so each needs only one halo.
    if up(math.ceil(up(length, multiple) / 2), multiple) + halo <= longest:
        return 2
    room = (longest - 2 * halo) // multiple * multiple
    return math.ceil(length / room) if room > 0 else None


def _least(multiple: int, halo: int) -> int:
    """The least that a tile is valid in, along one axis."""
    return max(multiple, 2 * halo)


def up(value: int, multiple: int) -> int:
    """`value` rounded up to a multiple."""
    return -(-value // multiple) * multiple
