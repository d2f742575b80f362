"""What HBAO and GTAO share: their parameters, a sample's elevation, and the Method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import TINY, Screen, open_screen, smoothed
from deepshade_report.tuning import Ranges


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `radius` multiplies the effect's. `falloff` in (0, 1] is the share of it over which samples
    lose their weight, up to the radius (HBAO: of its square). `bias` is how far over the tangent a
    sample must rise (HBAO: in radians, GTAO: in sines). `spread` is the power that draws samples
    towards the pixel. Occlusion is multiplied by `intensity`, what is left open is raised to
    `power`. `blur` is the filter's half width in pixels (0 = none), `edge` the depth step, in
    radii, that stops it.
    """

    radius: float
    falloff: float
    bias: float
    spread: float
    intensity: float = 1.0
    power: float = 1.0
    blur: int = 3
    edge: float = 0.2


RANGES: Ranges = {
    "radius": (0.4, 2.5),
    "falloff": (0.05, 1.0),
    "bias": (0.0, 0.6),
    "spread": (1.0, 2.5),
    "intensity": (0.5, 2.5),
    "power": (0.4, 2.5),
    "blur": (0, 6),
    "edge": (0.02, 0.5),
}


def marching(
    name: str, settings: dict[str, int], parameters: Parameters, kernel: Callable[..., Any]
) -> Filter:
    """A Method whose answers are in [0, 1], 1 = open.

    `settings` are how many directions or slices, and how many steps in each. The `kernel` gives
    every pixel's occlusion of a Screen, these counts and all parameters but the filter's two.
    """

    return Filter(name, settings, parameters, open_screen, partial(openness, kernel))


def openness(
    kernel: Callable[..., Any], screen: Screen, ways: int, steps: int, *given: float
) -> Any:
    """What such a kernel finds of a Screen, with the values of all Parameters, smoothed.

    Of a kernel that gives more planes, those too; the first is occlusion.
    """
    *rest, blur, edge = given
    counts = [dr.opaque(mi.UInt32, count) for count in (ways, steps)]
    numbers = [dr.opaque(mi.Float, float(value)) for value in rest]
    image = smoothed(screen, kernel(screen, *counts, *numbers), int(blur), edge)
    if not isinstance(image, mi.Float):
        return image
    return dr.select(screen.depth > 0, dr.clip(image, 0, 1), 1)


def sample(
    screen: Screen, here: Any, eye: Any, column: Any, row: Any, right: Any, down: Any, side: int
) -> tuple[Any, Any]:
    """A sample's elevation (sine) and squared distance; far off for nothing."""
    c = mi.Int32(dr.round(mi.Float(column) + side * right))
    r = mi.Int32(dr.round(mi.Float(row) + side * down))
    depth, inside = screen.look(screen.depth, c, r)
    delta = screen.position(c, r, depth) - here
    squared = dr.squared_norm(delta)
    elevation = dr.dot(delta, eye) * dr.rsqrt(dr.maximum(squared, TINY))
    return elevation, dr.select(inside & (depth > 0), squared, 1e18)
