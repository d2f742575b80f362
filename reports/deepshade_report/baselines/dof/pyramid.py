"""Light and blur radius at several resolutions, and how far near surfaces blur into each tile.

The layout of Filament's depth of field (Google, Apache-2.0, `filament/src/materials/dof`): a
coarse texel takes the nearest radius of its four, so that what lies near may spread and nothing
else spreads over it, and the light of those that are about as far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepshade_report.baselines.picture import Grid, light, mi, plain
from deepshade_report.view import View

LEVELS = 5
TILE_LEVEL = 3  # a tile is 8 x 8 pixels


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Pyramid:
    """All levels' texels in one row of planes: light, and signed radius in pixels (near < 0).

    `grids` are the levels' sizes; `starts`, `widths` and `heights` say on the device where each
    lies.
    """

    grids: list[Grid]
    light: Any
    radius: Any
    starts: Any
    widths: Any
    heights: Any

    def texel(self, level: Any, x: Any, y: Any) -> Any:
        """The index of the texel of a level around a place in pixels, or of the nearest one."""
        scale = mi.Float(1 << level)
        start, width, height = (
            dr.gather(mi.Int32, table, level) for table in (self.starts, self.widths, self.heights)
        )
        return texel(start, width, height, 1 / scale, x, y)


def texel(start: Any, width: Any, height: Any, scale: Any, x: Any, y: Any) -> Any:
    """The index around a place in pixels, where a level's look-ups are known."""
    column = dr.clip(mi.Int32(dr.floor(x * scale)), 0, width - 1)
    row = dr.clip(mi.Int32(dr.floor(y * scale)), 0, height - 1)
    return mi.UInt32(start + row * width + column)


def upload(view: View) -> tuple[Grid, Any, Any]:
    """The picture's grid, its light and its signed blur radius in pixels, on the device."""
    radius = plain(view.attributes["focal"][0] / 2)
    return Grid.of(view.height, view.width), light(view.attributes["light"]), radius


def build(grid: Grid, colour: Any, radius: Any) -> Pyramid:
    """The pyramid of a picture."""
    grids, colours, radii = [grid], [colour], [radius]
    for _ in range(1, LEVELS):
        height, width = ((size + 1) // 2 for size in grids[-1].shape)
        grids.append(Grid.of(height, width))
        smaller = _halved(grids[-2], grids[-1], colours[-1], radii[-1])
        dr.eval(smaller)
        colours.append(smaller[0])
        radii.append(smaller[1])
    sizes = [g.shape[0] * g.shape[1] for g in grids]
    starts = [sum(sizes[:level]) for level in range(LEVELS)]
    row = mi.Color3f(*(dr.concat([c[band] for c in colours]) for band in range(3)))
    joined = dr.concat(radii)
    dr.eval(row, joined)
    widths, heights = [g.shape[1] for g in grids], [g.shape[0] for g in grids]
    return Pyramid(grids, row, joined, *(_table(each) for each in (starts, widths, heights)))


def _table(values: list[int]) -> Any:
    """Numbers on the device, made there: what is copied to it can't be recorded."""
    return dr.concat([dr.opaque(mi.Int32, value) for value in values])


def _halved(fine: Grid, coarse: Grid, colour: Any, radius: Any) -> tuple[Any, Any]:
    column, row = coarse.pixels()
    four = [fine.at(2 * column + right, 2 * row + down) for down in (0, 1) for right in (0, 1)]
    radii = [dr.gather(mi.Float, radius, index) for index in four]
    nearest = dr.minimum(dr.minimum(radii[0], radii[1]), dr.minimum(radii[2], radii[3]))
    total, weights = mi.Color3f(0), mi.Float(0)
    for index, other in zip(four, radii, strict=True):
        weight = dr.clip(1 - (other - nearest), 0, 1)
        total += dr.gather(mi.Color3f, colour, index) * weight
        weights += weight
    return total / weights, nearest


@dr.syntax
def near_reach(pyramid: Pyramid, longest: Any) -> Any:
    """For each tile, the largest radius, in pixels, of a near surface that may blur into it.

    `longest` is the largest radius that is looked for, in pixels.
    """
    grid = pyramid.grids[TILE_LEVEL]
    start = dr.gather(mi.Int32, pyramid.starts, mi.UInt32(TILE_LEVEL))
    size = float(1 << TILE_LEVEL)
    around = mi.Int32(dr.ceil(longest / size))
    column, row = grid.pixels()
    reach = mi.Float(0)
    down = -around
    while down <= around:
        right = -around
        while right <= around:
            found = dr.gather(mi.Float, pyramid.radius, start + grid.at(column + right, row + down))
            x, y = (dr.maximum(dr.abs(mi.Float(d)) - 1, 0) * size for d in (right, down))
            reaches = -found >= dr.sqrt(x * x + y * y)
            reach = dr.select(reaches, dr.maximum(reach, -found), reach)
            right += 1
        down += 1
    return dr.minimum(reach, longest)
