"""A view's environment on the device, blurred by cosine lobes, and looked up by direction.

Like the mip chain of engines, which the lobes' tiles (`deepshade.environments.lobes`) stand for:
coarse where a lobe is wide. Preparing it is no part of shading a frame, as it isn't of ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade.camera import rotation_of
from deepshade.environments import Environment, world_to_map
from deepshade.environments.lobes import TILES
from deepshade_report.baselines.picture import mi
from deepshade_report.view import View, require
from deepshade_trainer.evaluation import prepared

MEAN, MIRROR = 0, len(TILES) - 1  # tiles; that of the exponent 2^k is k + 1


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Chain:
    """Tiles in one row of texels, four floats each, and where each begins; `turn` is to the map.

    `mean` is the environment's mean radiance.
    """

    texels: Any
    starts: Any
    rows: Any
    turn: list[Any]
    mean: Any

    def angles(self, direction: Any) -> tuple[Any, Any]:
        """Where a direction, of any length, lies in a map: from its left and top, 0 to 1."""
        x, y, z = (dr.dot(row, direction) for row in self.turn)
        u = dr.fma(dr.atan2(x, -z), dr.inv_two_pi, 0.5)
        return u, dr.atan2(dr.sqrt(x * x + z * z), y) * dr.inv_pi

    def look(self, level: Any, u: Any, v: Any) -> Any:
        """Radiance (Color3f), bilinear, of the tile number `level` of this chain."""
        rows = dr.gather(mi.Float, self.rows, level)
        start = dr.gather(mi.UInt32, self.starts, level)
        x, y = dr.fma(2 * rows, u, 0.5), dr.fma(rows, v, 0.5)  # around a tile lies one pixel
        left, top = dr.floor(x), dr.floor(y)
        right, down = x - left, y - top
        line = 2 * mi.UInt32(rows) + 2
        corner = start + mi.UInt32(top) * line + mi.UInt32(left)
        four = [
            dr.gather(mi.Vector4f, self.texels, corner + extra) for extra in (0, 1, line, line + 1)
        ]
        upper, lower = (dr.lerp(four[k], four[k + 1], right) for k in (0, 2))
        found = dr.lerp(upper, lower, down)
        return mi.Color3f(found.x, found.y, found.z)


def open_chain(view: View, tiles: Sequence[int], *, camera_space: bool = False) -> Chain:
    """The view's environment, for directions of the world or of the camera's space.

    Raises DataError: the view has none.
    """
    lit = require(view)
    turn = world_to_map(lit.degrees, lit.up)
    if camera_space:
        turn = turn @ rotation_of(view.camera.matrix).T
    return Chain(*_uploaded(lit.environment, tuple(tiles)), vectors(turn), colour(lit.mean))


def vectors(rows: NDArray[np.floating]) -> list[Any]:
    """Rows of three numbers on the device."""
    return [mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in row)) for row in rows]


def colour(value: NDArray[np.floating]) -> Any:
    """Three numbers on the device."""
    return mi.Color3f(*(dr.opaque(mi.Float, float(band)) for band in value))


@lru_cache(maxsize=4)
def _uploaded(environment: Environment, tiles: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Texels, starts and rows."""
    table = prepared(environment).tables["lobes"][0]
    parts, starts, begin = [], [], 0
    for tile in (TILES[index] for index in tiles):
        down, right = tile.row + tile.rows + 1, tile.column + 2 * tile.rows + 1
        picture = table[:, tile.row - 1 : down, tile.column - 1 : right].reshape(3, -1)
        parts.append(np.concatenate([picture, picture[:1]]).T.ravel())
        starts.append(begin)
        begin += picture.shape[1]
    rows = [float(TILES[index].rows) for index in tiles]
    found = mi.Float(np.concatenate(parts)), mi.UInt32(starts), mi.Float(rows)
    dr.eval(found)
    return found
