"""A clear sky with its sun over a plain ground, as an environment map.

Sky: Preetham, Shirley and Smits, "A Practical Analytic Model for Daylight", SIGGRAPH 1999 (its
appendix has the coefficients below). Sun: what is left of its light outside the atmosphere after
Rayleigh and aerosol scattering, from the same appendix, at one wavelength for each channel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, directions, solid_angles
from deepshade.errors import ConfigError

Array = NDArray[np.float64]

SUN_RADIUS = math.radians(0.2666)
SUN_ILLUMINANCE = 133.8  # outside the atmosphere, in klx: 1361 W/m² at 98 lm/W
# name -> (lowest, highest); beyond these the model has no meaning
RANGES = {"elevation": (1.0, 90.0), "turbidity": (2.0, 10.0), "ground": (0.0, 1.0)}

_WAVELENGTHS = np.array([0.65, 0.55, 0.45])  # of red, green and blue, in µm
_FINER = 16  # sub-pixels of a side, for how much of a pixel the sun covers

# A to E, for luminance Y and the chromaticities x and y: times turbidity, and added to that
_BY_TURBIDITY = np.array(
    [
        [0.1787, -0.3554, -0.0227, 0.1206, -0.0670],
        [-0.0193, -0.0665, -0.0004, -0.0641, -0.0033],
        [-0.0167, -0.0950, -0.0079, -0.0441, -0.0109],
    ]
)
_CONSTANT = np.array(
    [
        [-1.4630, 0.4275, 5.3251, -2.5771, 0.3703],
        [-0.2592, 0.0008, 0.2125, -0.8989, 0.0452],
        [-0.2608, 0.0092, 0.2102, -1.6537, 0.0529],
    ]
)
# chromaticities at the zenith: rows by powers of turbidity (2, 1, 0), columns of the sun's angle
# from the zenith (3, 2, 1, 0)
_ZENITH_X = np.array(
    [
        [0.00166, -0.00375, 0.00209, 0],
        [-0.02903, 0.06377, -0.03202, 0.00394],
        [0.11693, -0.21196, 0.06052, 0.25886],
    ]
)
_ZENITH_Y = np.array(
    [
        [0.00275, -0.00610, 0.00317, 0],
        [-0.04214, 0.08970, -0.04153, 0.00516],
        [0.15346, -0.26756, 0.06670, 0.26688],
    ]
)
# CIE XYZ to linear sRGB, IEC 61966-2-1
_TO_RGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)


def sky(
    name: str = "sky",
    *,
    elevation: float = 35.0,
    azimuth: float = 40.0,
    turbidity: float = 3.0,
    ground: float = 0.2,
    height: int = 256,
) -> Environment:
    """A map of 2 `height` x `height` pixels, scaled so that white ground would be at 1.

    `elevation` is the sun's above the horizon and `azimuth` where it stands, in degrees to the
    right of the map's centre; `turbidity` is how hazy the air is (2 very clear, 10 haze), and
    `ground` the reflectance of what lies below. Raises ConfigError outside `RANGES`.
    """
    for key, value in {"elevation": elevation, "turbidity": turbidity, "ground": ground}.items():
        lowest, highest = RANGES[key]
        if not lowest <= value <= highest:
            raise ConfigError(
                key, detail=f"the sky's {key} is {value}, it must lie in {lowest:g} … {highest:g}"
            )
    at, around = math.radians(elevation), math.radians(azimuth)
    sun = np.array(
        [math.sin(around) * math.cos(at), math.sin(at), -math.cos(around) * math.cos(at)]
    )
    grid = directions(height, 2 * height)
    weights = solid_angles(height, 2 * height)[:, None]
    above = grid[1] > 0
    light = np.where(above, _dome(grid, sun, turbidity), 0)
    light += _disc(sun, height) * _sunlight(at, turbidity)[:, None, None] / weights
    floor = (light * np.where(above, grid[1], 0) * weights).sum((1, 2)) / math.pi
    light = np.where(above, light, ground * floor[:, None, None])
    return Environment(name, light / floor.mean())


def _dome(grid: Array, sun: Array, turbidity: float) -> Array:
    """(3, H, W): the sky's colour in kcd/m², without its sun; not for below the horizon."""
    theta = math.acos(min(1.0, sun[1]))
    cosine = np.maximum(grid[1], 1e-3)
    gamma = np.arccos(np.clip(np.tensordot(sun, grid, axes=1), -1, 1))
    at = np.vander([theta], 4)[0]
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * theta)
    zenith = (
        (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192,
        np.vander([turbidity], 3)[0] @ _ZENITH_X @ at,
        np.vander([turbidity], 3)[0] @ _ZENITH_Y @ at,
    )

    def perez(index: int, cosine: Array, gamma: Array) -> Array:
        a, b, c, d, e = _BY_TURBIDITY[index] * turbidity + _CONSTANT[index]
        around = 1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2
        return np.asarray((1 + a * np.exp(b / cosine)) * around)

    up, away = np.ones(1), np.array([theta])
    luminance, x, y = (zenith[i] * perez(i, cosine, gamma) / perez(i, up, away) for i in range(3))
    luminance = np.maximum(luminance, 0)
    xyz = np.stack([x / y * luminance, luminance, (1 - x - y) / y * luminance])
    return np.maximum(np.tensordot(_TO_RGB, xyz, axes=1), 0)


def _sunlight(elevation: float, turbidity: float) -> Array:
    """(3,): illuminance by the sun, in klx, on a plane that faces it."""
    degrees = math.degrees(math.pi / 2 - elevation)
    mass = 1 / (math.sin(elevation) + 0.15 * (93.885 - degrees) ** -1.253)
    rayleigh = np.exp(-0.008735 * _WAVELENGTHS**-4.08 * mass)
    aerosols = np.exp(-(0.04608 * turbidity - 0.04586) * _WAVELENGTHS**-1.3 * mass)
    return np.asarray(SUN_ILLUMINANCE * rayleigh * aerosols)


def _disc(sun: Array, height: int) -> Array:
    """(H, W): the share of the sun's light that comes through each pixel; they add to 1.

    Where it is smaller than a pixel, all of it through one.
    """
    share = np.zeros((height, 2 * height))
    row = min(height - 1, int(math.acos(min(1.0, sun[1])) / math.pi * height))
    column = int((math.atan2(sun[0], -sun[2]) / (2 * math.pi) + 0.5) * 2 * height) % (2 * height)
    reach = math.ceil(SUN_RADIUS / math.pi * height)
    for at in range(max(0, row - reach), min(height, row + reach + 1)):
        v = (at + (np.arange(_FINER) + 0.5) / _FINER) * math.pi / height
        u = (np.arange(2 * height * _FINER) + 0.5) / (height * _FINER) * math.pi - math.pi
        cosine = np.sin(v)[:, None] * (np.sin(u) * sun[0] - np.cos(u) * sun[2])
        cosine += np.cos(v)[:, None] * sun[1]
        inside = (cosine > math.cos(SUN_RADIUS)) * np.sin(v)[:, None]
        share[at] = inside.sum(0).reshape(2 * height, _FINER).sum(1)
    if share.sum() == 0:
        share[row, column] = 1
    return np.asarray(share / share.sum())
