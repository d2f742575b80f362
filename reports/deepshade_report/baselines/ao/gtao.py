"""GTAO: ground-truth ambient occlusion.

J. Jimenez, X.-C. Wu, A. Pesce, A. Jarabo: "Practical Real-Time Strategies for Accurate Indirect
Occlusion", Activision technical memo ATVI-TR-16-01 and SIGGRAPH 2016 course. The cosine-weighted
integral over the hemisphere is taken slice by slice through the eye's ray: horizons to both sides
by marching, then in closed form for the normal projected into the slice (the memo's equations
5 to 10),

    1/4 Σ (cos γ + 2 h sin γ - cos(2 h - γ)) · |projected normal|

with the horizon angles h from the eye's ray and the projected normal's angle γ. The falloff and the
spread of samples are those of Intel's XeGTAO 1.30 (F. Strugar and S. McCalla, 2021). The memo's
thickness heuristic and XeGTAO's thin-occluder compensation are left out: a search over both, 161
trials, found the least error without them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao.marching import RANGES, Parameters, marching, sample
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import TINY, Screen, across, plane, start, stride
from deepshade_report.tuning import Tunable, tuned

# slices and steps to each side, from cheap to best
SETTINGS = ((1, 2), (2, 2), (2, 4), (3, 6), (6, 8), (9, 12))
QUICK = ((2, 4), (6, 8))


# XeGTAO's RadiusMultiplier, EffectFalloffRange and SampleDistributionPower
PUBLISHED = Parameters(radius=1.457, falloff=0.615, bias=0.0, spread=2.0, blur=2)


def gtao(slices: int, steps: int, parameters: Parameters | None = None) -> Filter:
    """GTAO as a Method, with the parameters that were tuned or those given."""
    settings = {"slices": slices, "steps": steps}
    parameters = parameters or Parameters(**tuned(__package__, "gtao"))
    return marching("GTAO", settings, parameters, march)


TUNABLE = Tunable(partial(gtao, 3, 6), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """GTAO at its settings, from cheap to best; in a quick report, two of them."""
    return [gtao(slices, steps) for slices, steps in (QUICK if quick else SETTINGS)]


def march(screen: Screen, *given: Any) -> Any:
    """Every pixel's openness, of the numbers of slices and steps and the parameters."""
    return _march(screen, False, *given).x


def march_bent(screen: Screen, *given: Any) -> Any:
    """Every pixel's openness, and the sum of open directions, cosine-weighted (Vector4f).

    That sum is XeGTAO's bent normal, not unit, in camera space. A slice's part is, with angles θ
    from the eye's ray, ∫ (cos θ, sin θ) cos(θ - γ) |sin θ| dθ between its horizons.
    """
    return _march(screen, True, *given)


@dr.syntax
def _march(screen: Screen, bent: bool, slices: Any, steps: Any, *given: Any) -> Any:
    radius, falloff, bias, spread, intensity, power = given
    column, row = screen.pixels()
    here, eye, facing, reach, active = start(screen, column, row)
    fade = -1 / (radius * falloff)
    total = mi.Float(0)
    lean_to = mi.Vector3f(0)
    index = mi.UInt32(0)
    while (index < slices) & active:
        sin, cos, length, tilt = plane(screen, eye, facing, index, slices)
        first, second = mi.Float(-tilt), mi.Float(tilt)
        step = mi.UInt32(0)
        while step < steps:
            right, down = stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            seen = []
            for side, low in ((1, -tilt), (-1, tilt)):  # unrolled
                elevation, squared = sample(screen, here, eye, column, row, right, down, side)
                weight = dr.clip(dr.fma(dr.sqrt(squared), fade, 1 / falloff), 0, 1)
                seen.append(dr.lerp(low, elevation - bias, weight))
            first = dr.maximum(first, seen[0])
            second = dr.maximum(second, seen[1])
            step += 1
        first, second = dr.clip(first, -1, 1), dr.clip(second, -1, 1)
        h0, h1 = dr.acos(first), -dr.acos(second)
        cosine = facing / dr.maximum(length, TINY)
        angle = dr.safe_acos(cosine)
        lean = dr.select(tilt < 0, -angle, angle)
        arc = 2 * cosine + 2 * (h0 + h1) * tilt - dr.cos(2 * h0 - lean) - dr.cos(2 * h1 - lean)
        total += dr.maximum(arc * 0.25 * length, 0)
        if dr.hint(bent, mode="scalar"):
            ahead, aside = mi.Float(0), mi.Float(0)
            for side, cut in ((1, first), (-1, second)):  # unrolled
                cubed = dr.power(dr.safe_sqrt(1 - dr.square(cut)), 3) / 3
                ahead += cosine * (1 - cut * cut * cut) / 3 + side * tilt * cubed
                aside += side * cosine * cubed + tilt * (2 / 3 - cut + cut * cut * cut / 3)
            lean_to += length * (ahead * eye + aside * across(eye, sin, cos))
        index += 1
    visible = dr.clip(1 + (total / mi.Float(slices) - 1) * intensity, 0, 1)
    visible = dr.select(active, dr.power(visible, power), 1)
    lean_to = dr.select(active, lean_to, screen.normal)
    return mi.Vector4f(visible, lean_to.x, lean_to.y, lean_to.z)
