"""HBAO: horizon-based ambient occlusion.

L. Bavoil, M. Sainz, R. Dimitrov: "Image-Space Horizon-Based Ambient Occlusion", SIGGRAPH 2008
talks; details from L. Bavoil and M. Sainz: "Screen Space Ambient Occlusion", NVIDIA, 2008. With
elevations measured in each direction's plane through the eye's ray, occlusion is

    1 / 2π ∫ (sin h(θ) - sin t(θ)) W(θ) dθ

for the horizon h, the tangent's elevation t and the attenuation W. The horizon is found by
marching; every sample that raises it adds its rise, attenuated by its own distance. Directions
come in opposite pairs, turned by a per-pixel jitter, and a depth-aware blur takes the noise out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao.screen import (
    Marching,
    Screen,
    mi,
    opaque,
    plane,
    sample,
    start,
    stride,
    tuned,
)
from deepshade_report.method import Method

# directions and steps a direction, from cheap to best
SETTINGS = ((4, 2), (4, 4), (8, 4), (8, 8), (16, 8))
QUICK = ((4, 4), (8, 8))


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `radius` multiplies the effect's. `falloff` in (0, 1] is the share of the squared radius over
    which attenuation fades to zero: 1 is W = 1 - (r / R)², as published; less keeps far occluders
    whole. `bias` is the angle over the tangent, in radians, below which nothing occludes.
    Occlusion is multiplied by `intensity`, what is left open is raised to `power`. `blur` is the
    filter's half width in pixels (0 = none), `edge` the depth step, in radii, that stops it.
    `spread` is the power that draws samples towards the pixel.
    """

    radius: float = 1.0
    falloff: float = 1.0
    bias: float = 0.1
    intensity: float = 1.0
    power: float = 1.0
    spread: float = 1.0
    blur: int = 3
    edge: float = 0.2


class HBAO(Marching):
    """HBAO as a Method."""

    name = "HBAO"

    def __init__(self, directions: int, steps: int, parameters: Parameters | None = None) -> None:
        settings = {"directions": directions, "steps": steps}
        super().__init__(settings, parameters or Parameters(**tuned("hbao")))

    def march(self, screen: Screen) -> Any:
        """See `Marching.march`."""
        p, (directions, steps) = self.parameters, self.counts
        counts = [dr.opaque(mi.UInt32, value) for value in (max(directions // 2, 1), steps)]
        given = p.radius, p.falloff, p.bias, p.spread, p.intensity, p.power
        return _march(screen, *counts, *opaque(*given))


def methods(quick: bool) -> Sequence[Method]:
    """HBAO at its settings, from cheap to best; in a quick report, two of them."""
    return [HBAO(directions, steps) for directions, steps in (QUICK if quick else SETTINGS)]


@dr.syntax
def _march(screen: Screen, pairs: Any, steps: Any, *given: Any) -> Any:
    radius, falloff, bias, spread, intensity, power = given
    column, row = screen.pixels()
    here, eye, facing, reach, active = start(screen, column, row)
    slope = -1 / (dr.square(radius) * falloff)
    total = mi.Float(0)
    index = mi.UInt32(0)
    while (index < pairs) & active:
        sin, cos, _, tilt = plane(screen, eye, facing, index, pairs)
        first, second = _lifted(-tilt, bias), _lifted(tilt, bias)
        step = mi.UInt32(0)
        while step < steps:
            right, down = stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            rises = []
            for side, horizon in ((1, first), (-1, second)):  # unrolled
                elevation, squared, _ = sample(screen, here, eye, column, row, right, down, side)
                weight = dr.clip(dr.fma(squared, slope, 1 / falloff), 0, 1)
                rise = dr.select(weight > 0, dr.maximum(elevation - horizon, 0), 0)
                total = dr.fma(weight, rise, total)
                rises.append(rise)
            first += rises[0]
            second += rises[1]
            step += 1
        index += 1
    visible = dr.clip(1 - total * intensity / (2 * mi.Float(pairs)), 0, 1)
    return dr.select(active, dr.power(visible, power), 1)


def _lifted(sin: Any, bias: Any) -> Any:
    """sin(t + bias), never past the zenith."""
    cos = dr.safe_sqrt(1 - dr.square(sin))
    up, over = dr.sincos(bias)
    lifted = sin * over + cos * up
    return dr.select(cos < up, dr.maximum(sin, lifted), lifted)
