"""Real spherical harmonics up to degree 3: 16 functions, orthonormal on the sphere.

In order of l² + l + m, polynomials of a direction's (x, y, z) with z as the axis. No sign
(-1)^m: Y of degree 1 are √(3/4π) (y, z, x). Formulas: Ramamoorthi and Hanrahan, "An Efficient
Representation for Irradiance Environment Maps", SIGGRAPH 2001, and, for degree 3, the table of
Sloan, "Stupid Spherical Harmonics Tricks", GDC 2008, with the signs of those.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, directions, solid_angles

COUNT = 16


def harmonics(x: Any, y: Any, z: Any) -> list[Any]:
    """The 16 functions at unit directions; x, y, z are arrays of any kind that has arithmetic."""
    return [
        sqrt(1 / (4 * pi)) + 0 * z,
        sqrt(3 / (4 * pi)) * y,
        sqrt(3 / (4 * pi)) * z,
        sqrt(3 / (4 * pi)) * x,
        sqrt(15 / (4 * pi)) * x * y,
        sqrt(15 / (4 * pi)) * y * z,
        sqrt(5 / (16 * pi)) * (3 * z * z - 1),
        sqrt(15 / (4 * pi)) * x * z,
        sqrt(15 / (16 * pi)) * (x * x - y * y),
        sqrt(35 / (32 * pi)) * y * (3 * x * x - y * y),
        sqrt(105 / (4 * pi)) * x * y * z,
        sqrt(21 / (32 * pi)) * y * (5 * z * z - 1),
        sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
        sqrt(21 / (32 * pi)) * x * (5 * z * z - 1),
        sqrt(105 / (16 * pi)) * z * (x * x - y * y),
        sqrt(35 / (32 * pi)) * x * (x * x - 3 * y * y),
    ]


def projected(
    environment: Environment, to_map: NDArray[np.floating[Any]] | None = None
) -> NDArray[np.float64]:
    """(3, 16): ∫ L_env Y dω for each colour, over the sphere of directions.

    `to_map` (3, 3), a rotation, turns directions of the space that the functions live in into the
    map's (`world_to_map`, times the turn from camera to world for camera space). Pixels count as
    their centres.
    """
    height, width = environment.shape
    seen = directions(height, width)
    if to_map is not None:
        seen = np.tensordot(np.asarray(to_map).T, seen, axes=1)
    weighted = environment.radiance * solid_angles(height, width)[:, None]
    return np.stack([(weighted * basis).sum((1, 2)) for basis in harmonics(*seen)], axis=1)
