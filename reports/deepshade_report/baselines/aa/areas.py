"""The areas that SMAA reads from a texture, in closed form.

Along rows and columns a silhouette is replaced by two straight pieces: from half a pixel up or
down, where a crossing edge ends the line, to its middle. Along diagonals it is a line between the
ends, or the mean of two where an end may be either of two (Jimenez et al. 2012, section 3.2;
`AreaTex.py` takes samples instead).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade_report.baselines.picture import mi

DIAGONAL = 20  # pixels to either side that the table of diagonals has


def line_areas(
    left: Any, right: Any, first: tuple[Any, Any], second: tuple[Any, Any]
) -> tuple[Any, Any]:
    """Areas that a line cuts off the pixel below it and the one above.

    `left` and `right` are how many pixels it goes on to either side; `first` and `second` say
    which edges cross it at its ends, below and above. Crossing edges on both sides go on as the
    other end doesn't.
    """
    one, two = (
        dr.select(below == above, 0.0, dr.select(above, 0.5, -0.5))
        for below, above in (first, second)
    )
    one, two = (
        dr.select(first[0] & first[1], -two, one),
        dr.select(second[0] & second[1], -one, two),
    )
    half = (left + right + 1) / 2
    here, above = mi.Float(0), mi.Float(0)
    for height, start in ((one, left), (two, right)):
        a, b = dr.minimum(start, half), dr.minimum(start + 1, half)
        area = dr.abs(height) * ((b - a) - (b * b - a * a) / (2 * half))
        here += dr.select(height < 0, area, 0)
        above += dr.select(height > 0, area, 0)
    return here, above


# where a diagonal starts and ends, from the corner below the pixel that it starts in, by crossing
# edges (0: none, 1: upright, 2: level, 3: both): the two possible lines
_A, _B, _O = (1, 0), (1, 1), (0, 0)
_LINES = {
    (0, 0): ((_B, _B), (_A, _A)),
    (0, 1): ((_O, _B), (_A, _B)),
    (0, 2): ((_O, _A), (_A, _A)),
    (0, 3): ((_O, _B), (_A, _A)),
    (1, 0): ((_A, _O), (_A, _A)),
    (1, 1): ((_A, _B), (_A, _B)),
    (1, 2): ((_A, _A), (_A, _A)),
    (1, 3): ((_A, _B), (_A, _A)),
    (2, 0): ((_B, _O), (_B, _A)),
    (2, 1): ((_B, _B), (_B, _B)),
    (2, 2): ((_B, _A), (_B, _A)),
    (2, 3): ((_B, _B), (_B, _A)),
    (3, 0): ((_B, _O), (_A, _A)),
    (3, 1): ((_B, _B), (_A, _B)),
    (3, 2): ((_B, _A), (_A, _A)),
    (3, 3): ((_B, _B), (_A, _A)),
}


@lru_cache(maxsize=1)
def diagonal_areas() -> Any:
    """On the device, the areas of the pixel and of that above: by both ends, left and right."""
    left, right = np.mgrid[:DIAGONAL, :DIAGONAL].astype(float)
    table = np.zeros((4, 4, DIAGONAL, DIAGONAL, 2))
    length = left + right + 1
    for ends, lines in _LINES.items():
        for start, end in lines:
            rise, run = length + end[1] - start[1], length + end[0] - start[0]
            for pixel in (0, 1):
                x, y = 1 + left - start[0], pixel + left - start[1]
                under = _under(x, y, rise, run)
                table[(*ends, ..., pixel)] += 0.5 * (under if pixel else 1 - under)
    return mi.Float(table.astype(np.float32).ravel())


def _under(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    rise: NDArray[np.float64],
    run: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The share of the unit square at (x, y) that lies under a line through the origin."""
    # rise (x + s) > run (y + 1 - t) for s, t in the unit square: rise s + run t > k
    k = run * (y + 1) - rise * x

    def corner(reach: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(reach, 0) ** 2

    cut = corner(k) - corner(k - rise) - corner(k - run) + corner(k - rise - run)
    area: NDArray[np.float64] = np.clip(1 - cut / (2 * np.maximum(rise * run, 1e-9)), 0, 1)
    return area
