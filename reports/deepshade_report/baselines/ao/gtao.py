"""GTAO: ground-truth ambient occlusion.

J. Jimenez, X.-C. Wu, A. Pesce, A. Jarabo: "Practical Real-Time Strategies for Accurate Indirect
Occlusion", Activision technical memo ATVI-TR-16-01 and SIGGRAPH 2016 course. The cosine-weighted
integral over the hemisphere is taken slice by slice through the eye's ray: horizons to both sides
by marching, then in closed form for the normal projected into the slice (the memo's equations
5 to 10),

    1/4 Σ (cos γ + 2 h sin γ - cos(2 h - γ)) · |projected normal|

with the horizon angles h from the eye's ray and the projected normal's angle γ. The falloff, the
spread of samples and the thin-occluder compensation are those of Intel's XeGTAO 1.30 (F. Strugar
and S. McCalla, 2021); the thickness heuristic is the memo's (its section on thickness).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao.screen import (
    TINY,
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

# slices and steps to each side, from cheap to best
SETTINGS = ((1, 2), (2, 2), (2, 4), (3, 6), (6, 8), (9, 12))
QUICK = ((2, 4), (6, 8))


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `radius` multiplies the effect's, and `falloff` in (0, 1] is the share of it over which
    samples lose their weight, up to the radius (XeGTAO's RadiusMultiplier and
    EffectFalloffRange). `bias` is how far, in sines, a sample must rise over the tangent.
    `thickness` in [0, 1] lets the horizon sink towards later samples that lie lower, as if
    occluders were thin. `thin` stretches depth in the falloff (ThinOccluderCompensation).
    Occlusion is multiplied by `intensity`, what is left open is raised to `power`
    (FinalValuePower). `spread` draws samples towards the pixel (SampleDistributionPower). `blur`
    is the filter's half width in pixels (0 = none), `edge` the depth step, in radii, that stops
    it.
    """

    radius: float = 1.457
    falloff: float = 0.615
    bias: float = 0.0
    thickness: float = 0.0
    thin: float = 0.0
    intensity: float = 1.0
    power: float = 1.0
    spread: float = 2.0
    blur: int = 2
    edge: float = 0.2


class GTAO(Marching):
    """GTAO as a Method."""

    name = "GTAO"

    def __init__(self, count: int, steps: int, parameters: Parameters | None = None) -> None:
        settings = {"slices": count, "steps": steps}
        super().__init__(settings, parameters or Parameters(**tuned("gtao")))

    def march(self, screen: Screen) -> Any:
        """See `Marching.march`."""
        p, (count, steps) = self.parameters, self.counts
        counts = [dr.opaque(mi.UInt32, value) for value in (count, steps)]
        given = p.radius, p.falloff, p.bias, p.thickness, p.thin, p.spread, p.intensity, p.power
        return _march(screen, *counts, *opaque(*given))


def methods(quick: bool) -> Sequence[Method]:
    """GTAO at its settings, from cheap to best; in a quick report, two of them."""
    return [GTAO(count, steps) for count, steps in (QUICK if quick else SETTINGS)]


@dr.syntax
def _march(screen: Screen, slices: Any, steps: Any, *given: Any) -> Any:
    radius, falloff, bias, thickness, thin, spread, intensity, power = given
    column, row = screen.pixels()
    here, eye, facing, reach, active = start(screen, column, row)
    fade = -1 / (radius * falloff)
    stretch = dr.square(1 + thin) - 1
    total = mi.Float(0)
    index = mi.UInt32(0)
    while (index < slices) & active:
        sin, cos, length, tilt = plane(screen, eye, facing, index, slices)
        first, second = mi.Float(-tilt), mi.Float(tilt)
        step = mi.UInt32(0)
        while step < steps:
            right, down = stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            seen = []
            for side, low in ((1, -tilt), (-1, tilt)):  # unrolled
                elevation, squared, deep = sample(screen, here, eye, column, row, right, down, side)
                far = dr.sqrt(dr.fma(dr.square(deep), stretch, squared))
                weight = dr.clip(dr.fma(far, fade, 1 / falloff), 0, 1)
                seen.append(dr.lerp(low, elevation - bias, weight))
            first = _raised(first, seen[0], thickness)
            second = _raised(second, seen[1], thickness)
            step += 1
        h0 = dr.acos(dr.clip(dr.maximum(first, -tilt), -1, 1))
        h1 = -dr.acos(dr.clip(dr.maximum(second, tilt), -1, 1))
        cosine = facing / dr.maximum(length, TINY)
        angle = dr.safe_acos(cosine)
        lean = dr.select(tilt < 0, -angle, angle)
        arc = 2 * cosine + 2 * (h0 + h1) * tilt - dr.cos(2 * h0 - lean) - dr.cos(2 * h1 - lean)
        total += dr.maximum(arc * 0.25 * length, 0)
        index += 1
    visible = dr.clip(1 + (total / mi.Float(slices) - 1) * intensity, 0, 1)
    return dr.select(active, dr.power(visible, power), 1)


def _raised(horizon: Any, seen: Any, thickness: Any) -> Any:
    """The horizon after a sample; it sinks towards lower ones as if occluders were thin."""
    return dr.select(seen >= horizon, seen, dr.lerp(horizon, seen, thickness))
