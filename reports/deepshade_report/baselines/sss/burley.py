"""Subsurface scattering by importance-sampled taps of Burley's normalised diffusion.

E. Golubev: "Efficient Screen-Space Subsurface Scattering Using Burley's Normalized Diffusion in
Real-Time", SIGGRAPH 2018 course; the profile is that of P. Christensen and B. Burley: "Approximate
Reflectance Profiles for Efficient Subsurface Scattering", Pixar technical memo 15-04, 2015; fewer
taps for small kernels as in O3DE's ScreenSpaceSubsurfaceScattering. Taps lie on a Fibonacci spiral
in the plane through the surface parallel to the picture, their radii drawn by the profile of the
channel that scatters the most, the spiral turned from pixel to pixel. Each is weighted by the
profile at its true distance in space over that at its radius, and the sum is normalised.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import TINY, smoothed
from deepshade_report.baselines.sss.surface import Surface, open_surface
from deepshade_report.tuning import Ranges, Tunable, tuned
from deepshade_report.view import View

SETTINGS = (8, 16, 32, 64, 128, 200)  # taps; O3DE has 200
QUICK = (16, 64)
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `width` multiplies the mean free path. Where 90 % of the light come from within `small` pixels
    a third of the taps do, within four times as many half of them. `blur` is the half width in
    pixels of the filter that takes the noise out (0 = none), `edge` the depth step that stops it.
    """

    width: float = 1.0
    small: float = 1.0
    blur: int = 0
    edge: float = 0.2


PUBLISHED = Parameters()
RANGES: Ranges = {
    "width": (0.7, 1.4),
    "small": (0.25, 4.0),
    "blur": (0, 6),
    "edge": (0.02, 0.5),
}


def burley(taps: int, parameters: Parameters | None = None) -> Filter:
    """The importance-sampled filter as a Method, with the parameters tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "burley"))
    return Filter("Burley", {"taps": taps}, parameters, upload, _shade)


TUNABLE = Tunable(partial(burley, 64), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method from few taps to many; in a quick report, twice."""
    return [burley(taps) for taps in (QUICK if quick else SETTINGS)]


def upload(view: View) -> tuple[Surface, Any]:
    """The view on the device, and its light and depth by one look: four floats a pixel.

    -1 marks a channel that doesn't scatter.
    """
    surface = open_surface(view)
    light = dr.select(surface.free > 0, dr.maximum(surface.light, 0), -1)
    packed = dr.ravel(mi.Vector4f(light.x, light.y, light.z, surface.screen.depth))
    dr.eval(packed)
    return surface, packed


def _shade(
    frame: tuple[Surface, Any], taps: int, width: float, small: float, blur: int, edge: float
) -> Any:
    surface, packed = frame
    numbers = [dr.opaque(mi.Float, value) for value in (width, small)]
    image = _gather(surface, packed, _spiral(taps), dr.opaque(mi.UInt32, taps), *numbers)
    if blur:  # nor may what doesn't scatter lend light here
        scatters = dr.select(surface.free > 0, mi.Color3f(1), 0)
        image = smoothed(surface.screen, image * scatters, blur, edge)
        image /= dr.maximum(smoothed(surface.screen, scatters, blur, edge), TINY)
    return dr.select(surface.free > 0, image, surface.light)


def radius(share: Any) -> Any:
    """Within which radius, in mean free paths, a share in [0, 1) of the light comes from.

    The inverse of 1 - e^(-r) / 4 - 3 e^(-r/3) / 4, which is a cubic in e^(-r/3) (Golubev 2018).
    """
    u = 1 - np.asarray(share, np.float64)
    g = np.cbrt(1 + 4 * u * (2 * u + np.sqrt(1 + 4 * u * u)))
    return 3 * np.log((1 + g + 1 / g) / (4 * u))


@lru_cache
def _spiral(taps: int) -> Any:
    """Four floats a tap, for a mean free path of 1: its place (x, y), radius, 1 / profile."""
    index = np.arange(taps)
    r = radius((index + 0.5) / taps)
    x, y = r * np.cos(index * _GOLDEN_ANGLE), r * np.sin(index * _GOLDEN_ANGLE)
    inverse = r / (np.exp(-r) + np.exp(-r / 3))
    return mi.Float(np.stack([x, y, r, inverse], 1).astype(np.float32).ravel())


@dr.syntax
def _gather(surface: Surface, packed: Any, spiral: Any, taps: Any, *given: Any) -> Any:
    width, small = given
    screen = surface.screen
    column, row = screen.pixels()
    depth = screen.depth
    here = screen.position(column, row, depth)
    free = surface.free * width
    most = dr.max(free)
    active = most > 0
    pixels = screen.scale * most / dr.maximum(depth, TINY)  # a mean free path's length
    fade = -1 / (3 * dr.maximum(free, TINY))
    footprint = 6.04 * pixels  # 90 % of the light
    step = dr.select(footprint > 4 * small, 1, dr.select(footprint > small, mi.UInt32(2), 3))
    sin, cos = dr.sincos(screen.turn * (2 * math.pi))
    total, weights = mi.Color3f(0), mi.Color3f(0)
    index = mi.UInt32(step // 2)
    while (index < taps) & active:
        tap = dr.gather(mi.Vector4f, spiral, index)
        right, down = tap.x * cos - tap.y * sin, tap.x * sin + tap.y * cos
        right *= pixels
        down *= pixels
        c = mi.Int32(dr.round(mi.Float(column) + right))
        r = mi.Int32(dr.round(mi.Float(row) + down))
        place, inside = screen.place(c, r)
        seen = dr.gather(mi.Vector4f, packed, place, inside)
        # where the tap itself, not its pixel's centre, meets that pixel's depth
        x = (mi.Float(column) + right + 0.5 - screen.axis.x) * seen.w / screen.scale
        y = (screen.axis.y - 0.5 - mi.Float(row) - down) * seen.w / screen.scale
        distance = dr.norm(mi.Vector3f(x, y, -seen.w) - here)
        decay = dr.exp(fade * distance)
        light = mi.Color3f(seen.x, seen.y, seen.z)
        weight = decay * (1 + dr.square(decay))
        weight *= tap.w * most * dr.rcp(dr.maximum(distance, TINY))
        weight = dr.select((light >= 0) & inside & (seen.w > 0), weight, 0)
        total = dr.fma(weight, light, total)
        weights += weight
        index += step
    return dr.select(weights > 0, total / weights, surface.light)
