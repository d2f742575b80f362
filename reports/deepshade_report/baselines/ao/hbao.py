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

from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao.marching import RANGES, Parameters, marching, sample
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import Screen, plane, start, stride
from deepshade_report.tuning import Tunable, tuned

# directions and steps a direction, from cheap to best
SETTINGS = ((4, 2), (4, 4), (8, 4), (8, 8), (16, 8))
QUICK = ((4, 4), (8, 8))


# W = 1 - (r / R)²
PUBLISHED = Parameters(radius=1.0, falloff=1.0, bias=0.1, spread=1.0)


def hbao(directions: int, steps: int, parameters: Parameters | None = None) -> Filter:
    """HBAO as a Method, with the parameters that were tuned or those given."""
    settings = {"directions": directions, "steps": steps}
    parameters = parameters or Parameters(**tuned(__package__, "hbao"))
    return marching("HBAO", settings, parameters, march)


TUNABLE = Tunable(partial(hbao, 8, 4), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """HBAO at its settings, from cheap to best; in a quick report, two of them."""
    return [hbao(directions, steps) for directions, steps in (QUICK if quick else SETTINGS)]


@dr.syntax
def march(screen: Screen, directions: Any, steps: Any, *given: Any) -> Any:
    """Every pixel's openness."""
    radius, falloff, bias, spread, intensity, power = given
    pairs = dr.maximum(directions // 2, 1)
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
                elevation, squared = sample(screen, here, eye, column, row, right, down, side)
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
