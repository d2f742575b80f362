"""What the reconstruction filters share: a moving picture on the device and its dominant motions.

M. McGuire, P. Hennessy, M. Bukowski, B. Osman: "A Reconstruction Filter for Plausible Motion
Blur", I3D 2012. Velocities are halves of what a pixel moves while the shutter is open, which is
open around the picture's time: a pixel's light spreads that far to either side. The picture is
cut into tiles as wide as the longest spread; the longest velocity in a tile and in its eight
neighbours is what may move into it (the paper's TileMax and NeighborMax).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.baselines.picture import Grid, light, mi, plain
from deepshade_report.view import View

FAR = 1e10  # depth of background
STILL = 0.5  # pixels of spread below which nothing is to be seen (McGuire 2012, section 2.3)


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Moving:
    """A view on the device: light, half-exposure velocity in pixels and its length, depth."""

    grid: Grid
    light: Any
    u: Any
    v: Any
    speed: Any
    depth: Any


def upload(view: View) -> Moving:
    """`view` on the device. Background is infinitely far and still."""
    motion, depth = view.attributes["motion"], view.attributes["depth"][0]
    there = ~view.background & np.isfinite(depth) & (depth > 0)
    u, v = (plain(np.where(there, plane / 2, np.float32(0))) for plane in motion)
    far = plain(np.where(there, depth, np.float32(FAR)))
    speed = dr.sqrt(u * u + v * v)
    dr.eval(speed)
    return Moving(
        Grid.of(view.height, view.width), light(view.attributes["light"]), u, v, speed, far
    )


def dominant(frame: Moving, tile: int) -> tuple[Any, Any, Any, Grid]:
    """The longest velocity about each tile of `tile` pixels: u, v, length, and the tiles' grid.

    Lengths are cut to `tile`: what spreads farther wouldn't be found by the tiles that it reaches.
    """
    height, width = frame.grid.shape
    rows, columns = -(-height // tile), -(-width // tile)
    size = dr.opaque(mi.Int32, tile)
    strips = Grid.of(height, columns)
    index = _longest_of_row(frame.speed, frame.grid, strips, size)
    dr.eval(index)
    tiles = Grid.of(rows, columns)
    index = _longest_of_column(frame.speed, index, strips, tiles, size)
    dr.eval(index)
    index = _longest_about(frame.speed, index, tiles)
    u, v, speed = (dr.gather(mi.Float, plane, index) for plane in (frame.u, frame.v, frame.speed))
    cut = dr.minimum(1, mi.Float(size) / dr.maximum(speed, STILL))
    u, v, speed = u * cut, v * cut, speed * cut
    dr.eval(u, v, speed)
    return u, v, speed, tiles


@dr.syntax
def _longest_of_row(speed: Any, grid: Grid, strips: Grid, tile: Any) -> Any:
    column, row = strips.pixels()
    best, longest = grid.at(column * tile, row), mi.Float(-1)
    step = mi.Int32(0)
    while step < tile:
        here = grid.at(column * tile + step, row)
        found = dr.gather(mi.Float, speed, here)
        better = found > longest
        best, longest = dr.select(better, here, best), dr.select(better, found, longest)
        step += 1
    return best


@dr.syntax
def _longest_of_column(speed: Any, index: Any, strips: Grid, tiles: Grid, tile: Any) -> Any:
    column, row = tiles.pixels()
    best, longest = mi.UInt32(0), mi.Float(-1)
    step = mi.Int32(0)
    while step < tile:
        here = dr.gather(mi.UInt32, index, strips.at(column, row * tile + step))
        found = dr.gather(mi.Float, speed, here)
        better = found > longest
        best, longest = dr.select(better, here, best), dr.select(better, found, longest)
        step += 1
    return best


def _longest_about(speed: Any, index: Any, tiles: Grid) -> Any:
    column, row = tiles.pixels()
    best, longest = mi.UInt32(0), mi.Float(-1)
    for down in (-1, 0, 1):  # unrolled
        for right in (-1, 0, 1):
            here = dr.gather(mi.UInt32, index, tiles.at(column + right, row + down))
            found = dr.gather(mi.Float, speed, here)
            better = found > longest
            best, longest = dr.select(better, here, best), dr.select(better, found, longest)
    return best


def nearer(depth: Any, than: Any, extent: Any) -> Any:
    """How much a surface at `depth` lies before one at `than`, 0 to 1, 1 where they are level.

    McGuire's soft comparison, with an extent relative to depth, as in KinoMotion (K. Takahashi,
    `Reconstruction.cginc`), so that a scene's scale changes nothing.
    """
    return dr.clip(1 + (than - depth) / (extent * dr.minimum(than, depth)), 0, 1)
