"""An environment as a few thousand distant lamps, each in a fixed direction.

What is learnt from many maps a second needs no finer one.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, directions, solid_angles

Float64 = NDArray[np.float64]
_ROWS = 4096  # directions compared at a time


def fibonacci(count: int) -> Float64:
    """(count, 3): unit directions that each stand for the same solid angle, as evenly as can be.

    Spherical Fibonacci points: Marques et al., "Spherical Fibonacci Point Sets for Illumination
    Integrals", Computer Graphics Forum 32, 2013.
    """
    index = np.arange(count)
    y = 1 - (2 * index + 1) / count
    phi = index * (math.pi * (3 - math.sqrt(5)))
    sine = np.sqrt(1 - y * y)
    return np.stack([sine * np.cos(phi), y, sine * np.sin(phi)], axis=1)


DIRECTIONS = fibonacci(512)  # in camera space: those whose visibility is rendered


def lamps(environment: Environment, count: int = 2048) -> tuple[Float64, Float64]:
    """Unit directions (count, 3) in the map's space, and ∫ L_env dω (count, 3) of what is nearest.

    A direction is the middle of the light that its lamp stands for: that of a sun stays.
    """
    points, toward, chosen = _cells(*environment.shape, count)
    weights = solid_angles(*environment.shape)[:, None]
    light = (environment.radiance * weights).reshape(3, -1)
    total = gathered(light.T, chosen, count)
    grey = light.mean(0)[:, None]
    middle = gathered(toward * grey, chosen, count)
    length = np.linalg.norm(middle, axis=1, keepdims=True)
    return np.where(length > 0, middle / np.where(length > 0, length, 1), points), total


@lru_cache(maxsize=4)
def _cells(height: int, width: int, count: int) -> tuple[Float64, Float64, NDArray[np.intp]]:
    points, toward = fibonacci(count), directions(height, width).reshape(3, -1).T
    return points, toward, nearest(toward, points)


def nearest(directions: Float64, points: Float64) -> NDArray[np.intp]:
    """(N,): which of the unit `points` (M, 3) is nearest to each unit direction (N, 3)."""
    columns = points.T.astype(np.float32)
    blocks = [directions[k : k + _ROWS] for k in range(0, len(directions), _ROWS)]
    return np.concatenate([(block.astype(np.float32) @ columns).argmax(1) for block in blocks])


def gathered(light: Float64, chosen: NDArray[np.intp], count: int) -> Float64:
    """(count, C): the sums of those rows of `light` (N, C) that have `chosen` the same number."""
    return np.stack([np.bincount(chosen, band, count) for band in light.T], axis=1)
