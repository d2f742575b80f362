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
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from deepshade_report.baselines.ao import tuned
from deepshade_report.baselines.ao.horizons import Field, Slice, blocks, finish, march, slices
from deepshade_report.baselines.ao.marching import Marching
from deepshade_report.method import Float, Method

if TYPE_CHECKING:
    from deepshade_report.baselines.ao.compiled import Screen

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


def occlude(field: Field, count: int, steps: int, p: Parameters) -> Float:
    """(H, W) ambient occlusion in [0, 1], 1 = open: `count` slices, `steps` to either side."""
    result = torch.empty(len(field.pixels))
    fade = 1 / (p.radius * p.falloff)
    stretch = (1 + p.thin) ** 2 - 1
    for some, block in blocks(field):
        total = torch.zeros_like(block.reach)
        for index, plane in slices(block, count):
            low, horizon = plane.low, plane.low.clone()
            samples = march(block, plane, index, steps, reach=p.radius, spread=p.spread)
            for elevation, squared, depth in samples:
                if stretch:
                    squared.addcmul_(depth, depth, value=stretch)
                weight = squared.sqrt_().mul_(-fade).add_(1 / p.falloff).clamp_(0, 1)
                if p.bias:
                    elevation.sub_(p.bias)
                seen = torch.lerp(low, elevation, weight)
                if p.thickness:
                    sunk = torch.lerp(horizon, seen, p.thickness)
                    horizon = torch.where(seen >= horizon, seen, sunk)
                else:
                    horizon = torch.maximum(horizon, seen)
            total += _arc(plane, torch.maximum(horizon, low), block.facing)
        visible = total.mul_(1 / count)
        visible = visible.sub_(1).mul_(p.intensity).add_(1).clamp_(0, 1)
        result[some] = visible if p.power == 1 else visible.pow_(p.power)
    return finish(field, result, blur=p.blur, edge=p.edge)


def _arc(plane: Slice, horizon: Tensor, facing: Tensor) -> Tensor:
    """The integral of a slice (n,), between its two horizons' cosines from the eye's ray (2, n)."""
    # an elevation's sine is its angle's cosine from the eye's ray
    cos_h = horizon.clamp(-1, 1)
    h = cos_h.acos()
    sin_h = (1 - cos_h * cos_h).clamp_(min=0).sqrt_()
    sin = plane.low[1]
    cos = facing / plane.length.clamp(min=1e-12)
    # to the second side angles count as negative
    sides = (h[0] - h[1]) * 2 * sin + 2 * cos
    double_cos = 2 * cos_h * cos_h - 1
    double_sin = 2 * cos_h * sin_h
    sides -= (double_cos[0] + double_cos[1]) * cos + (double_sin[0] - double_sin[1]) * sin
    return sides.mul_(0.25).mul_(plane.length).clamp_(min=0)


class GTAO(Marching):
    """GTAO as a Method."""

    name = "GTAO"

    def __init__(self, count: int, steps: int, parameters: Parameters | None = None) -> None:
        super().__init__({"slices": count, "steps": steps})
        self.count, self.steps = count, steps
        self.parameters = parameters or default()

    def march(self, screen: Screen) -> Float:
        """See `Marching.march`."""
        from deepshade_report.baselines.ao import compiled

        return compiled.gtao(screen, self.count, self.steps, self.parameters)


def default() -> Parameters:
    """The tuned parameters."""
    return Parameters(**tuned.parameters("gtao"))


def methods(quick: bool) -> Sequence[Method]:
    """GTAO at its settings, from cheap to best; in a quick report, two of them."""
    return [GTAO(count, steps) for count, steps in (QUICK if quick else SETTINGS)]
