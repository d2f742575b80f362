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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from deepshade_report.baselines.ao import tuned
from deepshade_report.baselines.ao.horizons import Field, Slice, blocks, finish, march, slices
from deepshade_report.baselines.ao.marching import Marching
from deepshade_report.method import Float, Method

if TYPE_CHECKING:
    from deepshade_report.baselines.ao.compiled import Screen

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


def occlude(field: Field, directions: int, steps: int, p: Parameters) -> Float:
    """(H, W) ambient occlusion in [0, 1], 1 = open, from `directions` (even) x `steps` samples."""
    result = torch.empty(len(field.pixels))
    pairs = max(directions // 2, 1)
    for some, block in blocks(field):
        total = torch.zeros_like(block.reach)
        for index, plane in slices(block, pairs):
            horizon = _start(plane, p.bias)
            rise_sum = torch.zeros_like(horizon)
            samples = march(block, plane, index, steps, reach=p.radius, spread=p.spread)
            for elevation, squared, _ in samples:
                slope = 1 / (p.radius**2 * p.falloff)
                weight = squared.mul_(-slope).add_(1 / p.falloff).clamp_(0, 1)
                rise = elevation.sub_(horizon).clamp_(min=0).mul_(weight > 0)
                rise_sum.addcmul_(weight, rise)
                horizon.add_(rise)
            total += rise_sum.sum(0)
        visible = total.mul_(-p.intensity / (2 * pairs)).add_(1).clamp_(0, 1)
        result[some] = visible if p.power == 1 else visible.pow_(p.power)
    return finish(field, result, blur=p.blur, edge=p.edge)


def _start(plane: Slice, bias: float) -> torch.Tensor:
    """sin(t + bias), never past the zenith."""
    sin = plane.low
    cos = (1 - sin * sin).clamp_(min=0).sqrt_()
    raised = sin * math.cos(bias) + cos * math.sin(bias)
    return torch.where(cos < math.sin(bias), torch.maximum(sin, raised), raised)


class HBAO(Marching):
    """HBAO as a Method."""

    name = "HBAO"

    def __init__(self, directions: int, steps: int, parameters: Parameters | None = None) -> None:
        super().__init__({"directions": directions, "steps": steps})
        self.directions, self.steps = directions, steps
        self.parameters = parameters or default()

    def march(self, screen: Screen) -> Float:
        """See `Marching.march`."""
        from deepshade_report.baselines.ao import compiled

        return compiled.hbao(screen, self.directions, self.steps, self.parameters)


def default() -> Parameters:
    """The tuned parameters."""
    return Parameters(**tuned.parameters("hbao"))


def methods(quick: bool) -> Sequence[Method]:
    """HBAO at its settings, from cheap to best; in a quick report, two of them."""
    return [HBAO(directions, steps) for directions, steps in (QUICK if quick else SETTINGS)]
