"""Directional occlusion by a visibility bitmask whose open sectors look up the environment.

O. Therrien, Y. Levesque, G. Gilet: "Screen Space Indirect Lighting with Visibility Bitmask", The
Visual Computer 2023, arXiv 2301.11376. In each slice through the eye's ray the half circle of
directions is 32 sectors of equal angle; each sample covers those between its front and its back,
which lies a thickness farther along the eye's ray. Each sector would see the environment:
neighbours share one look-up at their middle, in a map blurred to about their width, weighted by
the cosine and the measure of GTAO's integral, |sin θ| cos(θ - γ). As the effect's reference asks,
samples beyond the radius cover nothing.

The light of covered sectors is taken from the irradiance; or, with `ratio`, the irradiance is
multiplied by the share of the light that is left, and noise that both sums have cancels
(E. Heitz, S. Hill, M. McGuire: "Combining Analytic Direct Illumination and Stochastic Shadows",
I3D 2018). Where nothing is near, either gives the irradiance without noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.do.lit import Lit, open_lit
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import (
    GOLDEN,
    SECTORS,
    TINY,
    across,
    below,
    plane,
    smoothed,
    start,
    stride,
)
from deepshade_report.tuning import Ranges, Tunable, tuned

# slices, steps to each side, and look-ups a slice, from cheap to best
SETTINGS = ((1, 4, 4), (1, 8, 8), (2, 8, 8), (4, 8, 8), (4, 16, 16), (8, 24, 16))
QUICK = ((1, 8, 8), (4, 8, 8))


@dataclass(frozen=True)
class Parameters:
    """What can be tuned; lengths are in radii of the effect.

    Samples are taken, and count, up to `radius`. They are `thickness` thick, and thicker by
    `growth` for each radius that they are away from the eye. `spread` is the power that draws them
    towards the pixel. The environment is blurred by a cosine lobe of exponent 2^`octave`. What
    is blocked is multiplied by `intensity`. `ratio` is 1 for a quotient, 0 for a sum. `blur` is
    the filter's half width in pixels (0 = none), `edge` the depth step that stops it.
    """

    radius: float = 1.0
    thickness: float = 0.2
    growth: float = 0.0
    spread: float = 1.0
    intensity: float = 1.0
    octave: int = 5
    ratio: int = 0
    blur: int = 3
    edge: float = 0.2


PUBLISHED = Parameters()  # SSRT3's default: a thickness of 1 where the radius is 5
RANGES: Ranges = {
    "radius": (0.6, 1.5),
    "thickness": (0.01, 1.0),
    "growth": (0.0, 0.1),
    "spread": (1.0, 3.0),
    "intensity": (0.5, 1.5),
    "octave": (0, 10),
    "ratio": (0, 1),
    "blur": (0, 8),
    "edge": (0.02, 0.5),
}


def bitmask(slices: int, steps: int, lookups: int, parameters: Parameters | None = None) -> Filter:
    """The bitmask as a Method, with the parameters that were tuned or those given.

    `lookups` divides 32.
    """
    parameters = parameters or Parameters(**tuned(__package__, "bitmask"))
    settings = {"slices": slices, "steps": steps, "lookups": lookups}
    upload = partial(open_lit, octave=parameters.octave)
    return Filter("visibility bitmask", settings, parameters, upload, _shade, recorded=True)


TUNABLE = Tunable(partial(bitmask, 2, 8, 8), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method at its settings, from cheap to best; in a quick report, two of them."""
    return [bitmask(*counts) for counts in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, slices: int, steps: int, lookups: int, *given: float) -> Any:
    radius, thickness, growth, spread, intensity, _, ratio, blur, edge = given
    counts = [dr.opaque(mi.UInt32, count) for count in (slices, steps, lookups)]
    numbers = [dr.opaque(mi.Float, float(v)) for v in (radius, thickness, growth, spread)]
    opened, whole = _march(lit, *counts, *numbers)
    blocked = smoothed(lit.screen, whole - opened, int(blur), edge, bent=True)
    free = lit.irradiance(lit.screen.normal)
    if ratio:
        whole = smoothed(lit.screen, whole, int(blur), edge, bent=True)
        blocked = dr.select(whole > TINY, blocked / dr.maximum(whole, TINY), 0) * free
    image = dr.maximum(free - dr.opaque(mi.Float, float(intensity)) * blocked, 0)
    return dr.select(lit.screen.depth > 0, image, lit.chain.mean)


@dr.syntax
def _march(lit: Lit, slices: Any, steps: Any, lookups: Any, *given: Any) -> tuple[Any, Any]:
    """What the environment sends through open sectors, and through all."""
    radius, thickness, growth, spread = given
    screen = lit.screen
    column, row = screen.pixels()
    here, eye, facing, reach, active = start(screen, column, row)
    farthest = dr.square(radius)
    opened, whole = mi.Color3f(0), mi.Color3f(0)
    index = mi.UInt32(0)
    while (index < slices) & active:
        sin, cos, length, tilt = plane(screen, eye, facing, index, slices)
        up = dr.safe_sqrt(1 - dr.square(tilt))  # cosine of the projected normal's angle
        low = dr.asin(dr.clip(tilt, -1, 1)) - math.pi / 2
        turns = screen.turn * 5 + mi.Float(index) * GOLDEN
        jitter = turns - dr.floor(turns)
        covered = mi.UInt32(0)
        step = mi.UInt32(0)
        while step < steps:
            right, down = stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            for side in (1, -1):  # unrolled
                c = mi.Int32(dr.round(mi.Float(column) + side * right))
                r = mi.Int32(dr.round(mi.Float(row) + side * down))
                depth, inside = screen.look(screen.depth, c, r)
                delta = screen.position(c, r, depth) - here
                squared = dr.squared_norm(delta)
                near = inside & (depth > 0) & (squared <= farthest)
                rise = dr.dot(delta, eye)
                sunk = rise - dr.fma(depth, growth, thickness)
                beside = dr.maximum(squared - dr.square(rise), TINY)
                bounds = []
                for height in (rise, sunk):  # unrolled
                    cosine = height * dr.rsqrt(beside + dr.square(height))
                    angle = side * dr.acos(dr.clip(cosine, -1, 1)) - low
                    place = dr.fma(angle, SECTORS / math.pi, jitter)
                    bounds.append(below(mi.UInt32(dr.clip(place, 0, SECTORS))))
                bits = (bounds[1] & ~bounds[0]) if side == 1 else (bounds[0] & ~bounds[1])
                covered |= dr.select(near, bits, 0)
            step += 1
        aside = across(eye, sin, cos)
        wide = SECTORS // lookups  # sectors of a look-up
        width = math.pi / mi.Float(lookups)
        before = _weight(low, up, tilt)
        group = mi.UInt32(0)
        while group < lookups:
            end = low + mi.Float(group + 1) * width
            after = _weight(end, up, tilt)
            sine, ahead = dr.sincos(end - 0.5 * width)
            light = lit.seen(ahead * eye + sine * aside)
            light *= length * (after - before)
            some = (covered >> (group * wide)) & below(wide)
            share = 1 - mi.Float(dr.popcnt(some)) / mi.Float(wide)
            whole += light
            opened += share * light
            before = after
            group += 1
        index += 1
    count = 1 / mi.Float(slices)
    return opened * count, whole * count


def _weight(angle: Any, up: Any, tilt: Any) -> Any:
    """∫ |sin θ| cos(θ - γ) dθ from the eye's ray to an angle; γ's sine is `tilt`, cosine `up`."""
    sine, cosine = dr.sincos(angle)
    steep = dr.abs(sine)
    return 0.5 * dr.fma(up, sine * steep, tilt * (dr.abs(angle) - steep * cosine))
