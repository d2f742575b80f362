"""Pairs of neighbouring pixels on a fixed grid, and what they tell of normals and positions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.gbuffer.axes import Axes

Array = NDArray[np.floating[Any]]
Line = tuple[float, float]  # slope, and value at pixel 0

# pixels that each have a neighbour to the right and one below: usually, and where they don't tell
CENTRES = (200, 2000)
_OFF = 0.01  # of the picture's width: how far from its pixel a position may lie, in the median


@dataclass(frozen=True, slots=True)
class Pairs:
    """Pixels (2, N) by column and row: `[0]` and their neighbours `[1]`, `apart` pixels away."""

    columns: NDArray[np.intp]
    rows: NDArray[np.intp]
    width: int
    height: int

    @classmethod
    @lru_cache(64)  # pictures come in sequences
    def of(cls, shape: tuple[int, ...], *, apart: int = 1, centres: int = CENTRES[-1]) -> Pairs:
        """Of a picture (H, W): those on a grid of about as many `centres` that spans it."""
        height, width = shape
        step = max(1, round((height * width / centres) ** 0.5))
        ends: list[tuple[NDArray[Any], ...]] = []
        for right, down in ((apart, 0), (0, apart)):
            y, x = np.mgrid[0 : max(0, height - down) : step, 0 : max(0, width - right) : step]
            ends.append((x.ravel(), y.ravel(), x.ravel() + right, y.ravel() + down))
        x0, y0, x1, y1 = (np.concatenate(each) for each in zip(*ends, strict=True))
        return cls(np.stack([x0, x1]), np.stack([y0, y1]), width, height)

    @property
    def count(self) -> int:
        """How many pairs there are."""
        return int(self.columns.shape[1])

    @property
    def shape(self) -> tuple[int, int]:
        """(2, N)."""
        return 2, self.count

    @property
    def thin(self) -> bool:
        """Whether the picture is too narrow to tell where its pixels are."""
        return min(self.width, self.height) < 8

    def cut(self, array: NDArray[np.float32]) -> NDArray[np.float64]:
        """The pixels of a picture (C, H, W): (C, 2, N)."""
        flat = self.rows * self.width + self.columns
        return array.reshape(array.shape[0], -1)[:, flat].astype(np.float64)


def slopes_between(depths: Array, rays: Array) -> Array:
    """How planar depths (2, N) on rays (3, 2, N) change, for each unit of the picture plane (at
    distance 1) that they are apart: the change of their logarithm, (N,), then that distance."""
    apart = np.sqrt(((rays[:, 1] - rays[:, 0]) ** 2).sum(0))
    return np.stack([np.log(depths[1] / depths[0]) / apart, apart])


def misfits(
    normals: Array, rays: Array, slopes: Array, axes: tuple[Axes, ...]
) -> tuple[Array, Array]:
    """How far stored `normals` (3, 2, N) and `slopes_between` disagree if read with each of `axes`
    (0 to 1), and the share of normals that face the camera then; (K,) each.

    The plane on which normal n stands through a point of depth d on ray r meets the ray s at depth
    d (n·r) / (n·s). The mean over both ends' normals is exact to second order on a curved surface.
    The misfit is the mean difference of the slope, where those over 1 count as 1, as at edges.
    """
    # every stored component times every ray's, of both ends and both rays: (9, 4 N)
    products = normals[:, None, :, None] * rays[None, :, None, :]
    dots = _weights(axes) @ products.reshape(9, -1).astype(np.float32)
    dots = dots.reshape(len(axes), 2, 2, -1)  # normals of which end, ray of which end
    expected = dots[:, 0, 0] * dots[:, 1, 0] / (dots[:, 0, 1] * dots[:, 1, 1])
    change, apart = slopes.astype(np.float32)
    error = np.abs(change - np.log(expected) / (2 * apart))
    return np.fmin(error, 1).mean(1), (dots[:, 0, 0] < 0).mean(1)


@lru_cache(64)
def _weights(axes: tuple[Axes, ...]) -> NDArray[np.float32]:
    """Of which products of components a dot product consists: (K, 9)."""
    weights = np.zeros((len(axes), 9), np.float32)
    for row, each in zip(weights, axes, strict=True):
        for i, (axis, sign) in enumerate(zip(each.order, each.signs, strict=True)):
            row[3 * axis + i] = sign
    return weights


def projection(
    points: Array, columns: NDArray[np.intp], rows: NDArray[np.intp], *, parallel: bool = False
) -> tuple[Line, Line] | None:
    """How x / -z goes with columns and y / -z with rows where positions (3, N) lie on the rays of
    their pixels, before a camera at 0; None where they don't. `parallel` rays are orthographic."""
    depth = -points[2]
    if (depth > 0).mean() < 0.9:
        return None
    if not (depth > 0).all():
        good = depth > 0
        points, depth, columns, rows = points[:, good], depth[good], columns[good], rows[good]
    scale = np.ones_like(depth) if parallel else depth
    right = _line(points[0] / scale, columns)
    down = _line(points[1] / scale, rows)
    if right is None or down is None or right[0] <= 0 or down[0] >= 0:
        return None
    return right, down


def parallel(points: Array, reach: float) -> tuple[Array, Array]:
    """(depths (...), rays (3, ...) with z = -1) of camera-space points (3, ...) that parallel rays
    see, from so far back that they nearly are."""
    depth = reach - points[2]
    return depth, np.stack([points[0] / depth, points[1] / depth, np.full(depth.shape, -1.0)])


def _line(values: Array, pixels: NDArray[np.intp]) -> Line | None:
    """The line of `values` over `pixels`, if they lie on one, but for a few."""
    span = float(pixels.max() - pixels.min())
    if span < 4:
        return None
    x, y = pixels.astype(np.float64), values
    for _ in range(2):  # then without those that lie off: filtered edges, broken pixels
        middle, mean = x.mean(), y.mean()
        slope = float(((x - middle) * (y - mean)).sum() / ((x - middle) ** 2).sum())
        off = np.abs(y - mean - slope * (x - middle))
        usual = float(np.median(off))
        if off.max() < 0.1 * abs(slope):
            break
        near = off <= 4 * usual + 1e-12
        x, y = x[near], y[near]
    off_line = usual > max(1.0, _OFF * span) * abs(slope)
    return None if off_line else (slope, float(mean - slope * middle))
