"""Subsurface scattering by two one-dimensional passes.

J. Jimenez, K. Zsolnai, A. Jarabo, C. Freude, T. Auzinger, X.-C. Wu, J. von der Pahlen, M. Wimmer,
D. Gutierrez: "Separable Subsurface Scattering", Computer Graphics Forum 2015; details from the
authors' SeparableSSS.h. The kernel is the paper's pre-integrated one, here of Burley's profile:
what a line of light sends, exact where light changes along one axis only. Taps lie symmetrically,
closer to the centre, at multiples of each channel's mean free path; where the depth differs much, a
tap fades to the centre's own light ("follow surface"), as it does where nothing scatters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import TINY, Screen
from deepshade_report.baselines.sss.surface import Surface, open_surface
from deepshade_report.tuning import Ranges, Tunable, tuned
from deepshade_report.view import Float

SETTINGS = (7, 11, 17, 25, 41)  # taps a pass, odd; the paper's is 7, its code offers 11 to 25
QUICK = (7, 17)


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    The kernel reaches `reach` mean free paths to each side; `spread` is the power that draws taps
    to the centre. A tap counts as the centre where its depth differs by the reach over `edge`.
    """

    reach: float = 10.0
    spread: float = 2.0
    edge: float = 1.0


# the authors' code: offsets by squares, full fade where the depth differs by about the width
PUBLISHED = Parameters()
RANGES: Ranges = {"reach": (2.0, 24.0), "spread": (1.0, 3.0), "edge": (0.2, 10.0)}


def separable(taps: int, parameters: Parameters | None = None) -> Filter:
    """The two passes as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "separable"))
    return Filter("separable", {"taps": taps}, parameters, open_surface, _shade)


TUNABLE = Tunable(partial(separable, 17), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method from few taps to many; in a quick report, twice."""
    return [separable(taps) for taps in (QUICK if quick else SETTINGS)]


def _shade(surface: Surface, taps: int, reach: float, spread: float, edge: float) -> Any:
    offsets, weights = kernel(taps // 2, reach, spread)
    line = mi.Float(offsets[1:]), mi.Float(weights[1:]), dr.opaque(mi.UInt32, taps // 2)
    fade = dr.opaque(mi.Float, edge / reach)
    light = surface.light
    for down in (0, 1):
        planes = []
        for free, plane in zip(surface.free, light, strict=True):
            marked = dr.select(free > 0, plane, -1)  # what doesn't scatter lends nothing
            packed = dr.ravel(mi.Vector2f(marked, surface.screen.depth))
            dr.eval(packed)
            planes.append(_pass(surface.screen, packed, plane, free, *line, fade, down=down))
        light = mi.Color3f(*planes)
        dr.eval(light)
    return dr.select(surface.free > 0, light, surface.light)


@lru_cache
def kernel(side: int, reach: float, spread: float) -> tuple[Float, Float]:
    """Offsets, in mean free paths, and weights of the centre and of the taps to one side of it.

    A tap's weight is the line spread's integral between the middles to its neighbours; all, both
    sides', sum to 1. The line spread of Burley's profile is (K0(x) + K0(x / 3)) / 4π.
    """
    offsets = reach * (np.arange(side + 1) / side) ** spread
    middles = np.append((offsets[1:] + offsets[:-1]) / 2, reach)
    below = line_share(middles)
    weights = np.diff(below, prepend=0.0)
    weights[0] *= 2  # the centre's reaches to both sides
    weights /= weights[0] + 2 * weights[1:].sum()
    return offsets.astype(np.float32), weights.astype(np.float32)


def line_share(x: Any) -> Any:
    """How much of what a line of light sends arrives on one side within x mean free paths; < .5.

    Of the share of the profile that a circle of radius r holds, the part within x of its diameter
    is asin(x / r) / π to one side: integrated over the profile by quantiles of r.
    """
    from deepshade_report.baselines.sss.burley import radius

    r = radius((np.arange(20000) + 0.5) / 20000)
    return np.array([np.mean(np.arcsin(np.minimum(at / r, 1))) / np.pi for at in np.ravel(x)])


@dr.syntax
def _pass(
    screen: Screen,
    packed: Any,
    light: Any,
    free: Any,
    offsets: Any,
    weights: Any,
    count: Any,
    fade: Any,
    *,
    down: int,
) -> Any:
    column, row = screen.pixels()
    depth = screen.depth
    pixels = screen.scale * free / dr.maximum(depth, TINY)
    fade = fade / dr.maximum(free, TINY)
    active = free > 0
    total = mi.Float(0)
    index = mi.UInt32(0)
    while (index < count) & active:
        away = dr.gather(mi.Float, offsets, index) * pixels
        gained = mi.Float(0)
        for side in (1, -1):  # unrolled
            shift = dr.floor(side * away)
            part = side * away - shift
            for next_one in (0, 1):  # between two pixels; unrolled
                step = mi.Int32(shift) + next_one
                place, inside = screen.place(column + step * (1 - down), row + step * down)
                seen = dr.gather(mi.Vector2f, packed, place, inside)
                lost = dr.minimum(dr.abs(seen.y - depth) * fade, 1)
                lost = dr.select(inside & (seen.x >= 0), lost, 1)
                share = part if next_one else 1 - part
                gained += share * dr.lerp(seen.x - light, 0, lost)
        total = dr.fma(gained, dr.gather(mi.Float, weights, index), total)
        index += 1
    return light + total
