"""Where a picture needs its network: a coarse grid over it.

Python's integers serve as rows of bits: at 24 x 16 cells they answer what stands in a rectangle
in a microsecond or two, where a dozen array operations would take twenty.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from deepshade_service.tiles import up

Mask = NDArray[np.bool_]
Box = tuple[int, int, int, int]  # top, bottom, left, right; the ends are exclusive

_CELLS = 24  # along a picture's longer side, about
_FINEST, _COARSEST = 8, 64  # pixels


class Bits:
    """A small boolean picture (H, W) as integers, one for each row and one for each column."""

    def __init__(self, mask: Mask) -> None:
        self.shape = mask.shape
        self.rows = _integers(mask)
        self.columns = _integers(mask.T)

    def bounds(self, box: Box) -> Box | None:
        """The smallest box around what is set within `box`; None if nothing is."""
        top, bottom, left, right = box
        inside = ((1 << (right - left)) - 1) << left
        found, first, last = 0, top, top
        for at in range(top, bottom):
            row = self.rows[at] & inside
            if row:
                if not found:
                    first = at
                found |= row
                last = at
        if not found:
            return None
        return first, last + 1, (found & -found).bit_length() - 1, found.bit_length()

    def count(self, box: Box) -> int:
        """How many are set within `box`."""
        top, bottom, left, right = box
        inside = ((1 << (right - left)) - 1) << left
        return sum((row & inside).bit_count() for row in self.rows[top:bottom])


@dataclass(frozen=True)
class Grid:
    """Cells of `cell` pixels over a picture: those with geometry, those with pixels to answer.

    `height` and `width` are the picture's, in pixels.
    """

    height: int
    width: int
    cell: int
    geometry: Bits
    needed: Bits

    @classmethod
    def of(cls, background: Mask, known: Mask | None, multiple: int) -> Grid:
        """The grid of a picture whose `background` and `known` pixels (H, W) need no answer.

        Cells are multiples of `multiple`, the network's own.
        """
        height, width = background.shape
        side = min(_COARSEST, max(_FINEST, max(height, width) / _CELLS))
        cell = multiple * max(1, round(side / multiple))
        geometry = needed = Bits(~_all_in_cells(background, cell))
        if known is not None:
            needed = Bits(~_all_in_cells(background | known, cell))
        return cls(height, width, cell, geometry, needed)

    @cached_property
    def full(self) -> bool:
        """Whether every cell has something to answer."""
        every = (1 << self.needed.shape[1]) - 1
        return all(row == every for row in self.needed.rows)

    def pixels(self, cells: Box) -> Box:
        """A box of cells, in pixels; it may reach past the picture's end."""
        top, bottom, left, right = cells
        return top * self.cell, bottom * self.cell, left * self.cell, right * self.cell

    def touched(self, pixels: Box) -> Box:
        """The cells that a box of pixels touches."""
        top, bottom, left, right = pixels
        cell, (rows, columns) = self.cell, self.needed.shape
        return (
            top // cell,
            min(up(bottom, cell) // cell, rows),
            left // cell,
            min(up(right, cell) // cell, columns),
        )


def _integers(mask: Mask) -> list[int]:
    packed = np.packbits(mask, axis=1, bitorder="little")
    data, step = packed.tobytes(), packed.shape[1]
    return [int.from_bytes(data[at : at + step], "little") for at in range(0, len(data), step)]


def _all_in_cells(mask: Mask, cell: int) -> Mask:
    """(ceil(H / cell), ceil(W / cell)): whether the mask (H, W) holds in all of each cell."""
    return _all_along(_all_along(mask, cell).T, cell).T


def _all_along(mask: Mask, cell: int) -> Mask:
    """The same along the first axis. Reduces a view: reduceat would take ten times as long."""
    whole, rest = divmod(len(mask), cell)
    cells: Mask = np.all(mask[: whole * cell].reshape(whole, cell, mask.shape[1]), axis=1)
    return np.concatenate([cells, mask[whole * cell :].all(0, keepdims=True)]) if rest else cells
