"""Which pixels of an effect are known without a network: one small function for each effect.

A rule gets the G-buffer and the effect's radius (scene units) and returns the pixels whose answer
it can prove, or None when there are none or it can't tell. The answer holds the rule's value
there whether or not the network has run, so that skipping what is known changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from deepshade.camera import Camera
    from deepshade.gbuffer import GBuffer

# Depths as 16-bit floats are rounded by half of this share; a bound has to hold for what they were.
_ROUNDING = 1e-3
_SAMPLES = 16  # along each axis, of the pixels that positions are checked at


@dataclass(frozen=True, slots=True)
class Known:
    """Pixels (H, W) whose answer is `value`, which broadcasts to (outputs, H, W); and why."""

    pixels: NDArray[np.bool_]
    value: float | NDArray[np.float32]
    why: str


Rule = Callable[["GBuffer", float], Known | None]


@dataclass(frozen=True, slots=True)
class Sight:
    """How a picture's pixels look into the scene.

    `pitch` is the distance of neighbouring pixels' rays in the plane at depth 1 (the shorter of
    across and down), `longest` the length of the longest ray up to that plane, at least 1.
    """

    pitch: float
    longest: float

    def depth_beyond(self, radius: float) -> float:
        """The depth from which on no other pixel's ray comes within `radius` of a point.

        Let d = (a, b, -1) be the direction through a pixel, so that its point at depth z is z d,
        and d' = d + (p, q, 0) the direction through another. The distance of that point from the
        other's whole ray, whatever lies on it, is

            z |d x d'| / |d'|,  where  d x d' = d x (p, q, 0) = (q, -p, a q - b p),

        hence at least z sqrt(p² + q²) / |d'| >= z `pitch` / `longest`: two pixels differ by at
        least one step across or down, and no ray is longer than the longest. That exceeds
        `radius` when z > `radius` `longest` / `pitch`. On the axis the bound is exact up to
        `longest`; off the axis it only gets safer. It takes for granted that points lie on the
        rays through their pixels' centres, as the conventions say.
        """
        return radius * self.longest / self.pitch * (1 + _ROUNDING)


def no_occluder(gbuffer: GBuffer, radius: float) -> Known | None:
    """Ambient occlusion is 1 where the radius spans less than a pixel.

    What could occlude a point must lie within `radius` of it. Beyond `Sight.depth_beyond` no
    other pixel shows anything so near, and the point itself does not hide its own hemisphere: as
    far as the picture tells, nothing is in the way.

    The rays are those of the camera (field of view, windows, pixel aspect, shift), compared with
    the positions, because a header may be wrong. Without a camera they are those of the
    positions alone. Where neither gives them, or they contradict, nothing is known.
    """
    position = gbuffer.attributes.get("position")
    if position is None:
        return None
    stated = sight_of_camera(gbuffer.camera, *gbuffer.shape) if gbuffer.camera else None
    depth = position[2]  # negative, 0 in the background
    farthest = -float(depth.min())
    if stated is not None and not farthest > stated.depth_beyond(radius):
        return None  # as in most pictures: at the cost of one pass
    sight = sight_of_positions(position)
    if stated is not None and sight is not None:
        if not 0.9 < sight.pitch / stated.pitch < 1.1:
            return None
        sight = Sight(min(sight.pitch, stated.pitch), max(sight.longest, stated.longest))
    sight = sight or stated
    if sight is None:
        return None
    beyond = sight.depth_beyond(radius)
    if not farthest > beyond:
        return None
    why = f"the radius is less than a pixel at depths beyond {beyond:.6g}"
    return Known(depth < -beyond, 1.0, why)


def sight_of_camera(camera: Camera, height: int, width: int) -> Sight:
    """How a camera's stored pixels, `height` x `width` of them, look into the scene."""
    across = 1.0 / camera.pixels_per_unit
    down = across / camera.pixel_aspect
    left = (camera.x0 + 0.5 - 0.5 * camera.width) * across + camera.center[0]
    top = (0.5 * camera.height - camera.y0 - 0.5) * down + camera.center[1]
    x = max(abs(left), abs(left + (width - 1) * across))
    y = max(abs(top), abs(top - (height - 1) * down))
    return Sight(min(across, down), math.hypot(1.0, x, y))


def sight_of_positions(position: NDArray[np.float32]) -> Sight | None:
    """The same from camera-space positions (3, H, W), 0 in the background.

    A pinhole camera sees x / -z grow evenly from column to column, and y / -z from row to row.
    None if too few pixels are there to tell, or if positions don't follow that.
    """
    height, width = position.shape[1:]
    rows, columns = _spread(height), _spread(width)
    x, y, z = position[:, rows[:, None], columns].astype(np.float64)
    there = z < 0
    if np.count_nonzero(there) < 8:
        return None
    with np.errstate(all="ignore"):
        row, column = (i[there] for i in np.broadcast_arrays(rows[:, None], columns))
        across = _line(column, x[there] / -z[there])
        down = _line(row, y[there] / -z[there])
    if across is None or down is None:
        return None
    (right, left), (up, top) = across, down
    return Sight(
        min(abs(right), abs(up)),
        math.hypot(
            1.0,
            max(abs(left), abs(left + right * (width - 1))),
            max(abs(top), abs(top + up * (height - 1))),
        ),
    )


def _spread(length: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, length - 1, _SAMPLES).astype(np.intp))


def _line(at: NDArray[Any], value: NDArray[np.float64]) -> tuple[float, float] | None:
    """(slope, value at 0) of a straight line through the values, None if they are on none."""
    middle, mean = float(at.mean()), float(value.mean())
    offset = at - middle
    spread = float((offset * offset).sum())
    if spread == 0 or not math.isfinite(mean):
        return None
    slope = float((offset * (value - mean)).sum()) / spread
    off = float(np.abs(value - mean - slope * offset).max())
    # what 16-bit positions may be off by, beside half a pixel
    if slope == 0 or not off <= 0.5 * abs(slope) + _ROUNDING * (1 + abs(mean)):
        return None
    return slope, mean - slope * middle
