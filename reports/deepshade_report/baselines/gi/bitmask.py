"""Indirect light by a visibility bitmask.

O. Therrien, Y. Levesque, G. Gilet: "Screen Space Indirect Lighting with Visibility Bitmask", The
Visual Computer 2023, arXiv 2301.11376; parameters and details from SSRT3 (the authors'
implementation). In each slice through the eye's ray the half circle of directions is 32 sectors.
Samples are taken from near to far; each covers the sectors between its front and its back, which
lies a thickness farther along the eye's ray, and its light counts for those that nothing nearer
covered.

Different from SSRT3, as the effect's reference asks: sectors are of equal cosine-weighted solid
angle (with the measure of GTAO's integral, |sin θ| cos(θ - γ) times the length of the normal that
is projected into the slice), instead of equal angle, with the receiver's cosine multiplied in; the
emitter's cosine, which the solid angle holds already, isn't multiplied in once more; samples
beyond the radius neither light nor cover. Bounds of sectors are rounded at a jittered offset, so
that the sum over pixels is that of the unrounded angles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.gi.lit import LEVELS, Lit, open_lit, pyramid
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.baselines.screen import (
    GOLDEN,
    SECTORS,
    TINY,
    below,
    plane,
    smoothed,
    start,
    stride,
)
from deepshade_report.tuning import Ranges, Tunable, tuned

# slices and steps to each side, from cheap to best; SSRT3 offers 1 to 4 and 1 to 32
SETTINGS = ((1, 4), (1, 8), (2, 8), (4, 8), (4, 16), (8, 24))
QUICK = ((1, 8), (4, 8))


@dataclass(frozen=True)
class Parameters:
    """What can be tuned; lengths are in radii of the effect.

    Samples are taken, and count, up to `radius`. They are `thickness` thick, and thicker by
    `growth` for each radius that they are away from the eye (SSRT3's linear thickness). `spread`
    is the power that draws them towards the pixel. Light is the mean of as many pixels as samples
    are apart, times 2 to the power of `lod`, as from a mipmap. Of surfaces that face away from the
    pixel the share `backface` of their light counts: what their other side sends is unknown. All
    is multiplied by `intensity`. `blur` is the filter's half width in pixels (0 = none), `edge`
    the depth step that stops it.
    """

    radius: float = 1.0
    thickness: float = 0.2
    growth: float = 0.0
    spread: float = 1.0
    lod: float = -1.0
    backface: float = 0.0
    intensity: float = 1.0
    blur: int = 3
    edge: float = 0.2


# SSRT3's defaults: a thickness of 1 where the radius is 5, light of backfaces left out
PUBLISHED = Parameters()
RANGES: Ranges = {
    "radius": (0.6, 1.5),
    "thickness": (0.01, 1.0),
    "growth": (0.0, 0.1),
    "spread": (1.0, 3.0),
    "lod": (-4.0, 1.0),
    "backface": (0.0, 1.0),
    "intensity": (0.5, 2.0),
    "blur": (0, 8),
    "edge": (0.02, 0.5),
}


def bitmask(slices: int, steps: int, parameters: Parameters | None = None) -> Filter:
    """The visibility bitmask as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "bitmask"))
    settings = {"slices": slices, "steps": steps}
    return Filter("visibility bitmask", settings, parameters, open_lit, _shade)


TUNABLE = Tunable(partial(bitmask, 2, 8), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method at its settings, from cheap to best; in a quick report, two of them."""
    return [bitmask(slices, steps) for slices, steps in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, slices: int, steps: int, *given: float) -> Any:
    *rest, blur, edge = given
    counts = [dr.opaque(mi.UInt32, count) for count in (slices, steps)]
    numbers = [dr.opaque(mi.Float, float(value)) for value in rest]
    levels, places = pyramid(lit)
    dr.eval(levels)
    image = _march(lit, levels, places, *counts, *numbers)
    image = smoothed(lit.screen, image, int(blur), edge, bent=True)
    return dr.select(lit.screen.depth > 0, image, 0)


@dr.syntax
def _march(lit: Lit, levels: Any, places: Any, slices: Any, steps: Any, *given: Any) -> Any:
    radius, thickness, growth, spread, lod, backface, intensity = given
    screen = lit.screen
    column, row = screen.pixels()
    here, eye, facing, reach, active = start(screen, column, row)
    farthest = dr.square(radius)
    total = mi.Color3f(0)
    index = mi.UInt32(0)
    while (index < slices) & active:
        sin, cos, length, tilt = plane(screen, eye, facing, index, slices)
        up = dr.safe_sqrt(1 - dr.square(tilt))  # cosine of the projected normal's angle
        share = up + dr.asin(tilt) * tilt  # the measure of all sectors
        low = _measure(tilt, up, tilt, -1)
        turns = screen.turn * 5 + mi.Float(index) * GOLDEN
        jitter = turns - dr.floor(turns)
        per_unit = SECTORS / share
        covered = mi.UInt32(0)
        light = mi.Color3f(0)
        step = mi.UInt32(0)
        while step < steps:
            right, down = stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            away = dr.maximum(dr.abs(right), dr.abs(down))
            # samples of a power's spread are spread / steps / share of the way apart
            apart = away * spread / (mi.Float(step) + 0.5)
            level = dr.clip(dr.round(dr.log2(apart) + lod), 0, LEVELS - 1)
            level = mi.UInt32(level)
            first = dr.gather(mi.UInt32, places, level)
            line = dr.gather(mi.UInt32, places, level + LEVELS)
            for side in (1, -1):  # unrolled
                c = mi.Int32(dr.round(mi.Float(column) + side * right))
                r = mi.Int32(dr.round(mi.Float(row) + side * down))
                place, inside = screen.place(c, r)
                surface = dr.gather(mi.Vector4f, lit.surface, place, inside)
                delta = screen.position(c, r, surface.w) - here
                squared = dr.squared_norm(delta)
                near = inside & (surface.w > 0) & (squared <= farthest)
                rise = dr.dot(delta, eye)
                sunk = rise - dr.fma(surface.w, growth, thickness)
                across = dr.maximum(squared - dr.square(rise), TINY)
                edge = -side * tilt  # where the hemisphere ends
                front = dr.maximum(rise * dr.rsqrt(across + dr.square(rise)), edge)
                back = dr.maximum(sunk * dr.rsqrt(across + dr.square(sunk)), edge)
                bounds = []
                for bound in (front, back):  # unrolled
                    sine = dr.safe_sqrt(1 - dr.square(bound))
                    measure = low + side * _measure(bound, sine, tilt, side, up)
                    bounds.append(mi.UInt32(dr.maximum(dr.fma(measure, per_unit, jitter), 0)))
                most, least = (below(bounds[1]), below(bounds[0]))
                bits = (most & ~least) if side == 1 else (least & ~most)
                fresh = dr.select(near, bits & ~covered, 0)
                covered |= fresh
                wanted = fresh != 0
                smaller = first + mi.UInt32(r >> mi.Int32(level)) * line
                smaller += mi.UInt32(c >> mi.Int32(level))
                sent = dr.gather(mi.Vector4f, levels, smaller, wanted)
                turned = dr.dot(mi.Vector3f(surface.x, surface.y, surface.z), delta) > 0
                weight = mi.Float(dr.popcnt(fresh)) * dr.select(turned, backface, 1)
                weight = dr.select(wanted, weight * dr.rcp(dr.maximum(sent.w, 1)), 0)
                light = dr.fma(weight, mi.Color3f(sent.x, sent.y, sent.z), light)
            step += 1
        total = dr.fma(length * share / SECTORS, light, total)
        index += 1
    return total * (intensity / mi.Float(slices))


def _measure(cosine: Any, sine: Any, tilt: Any, side: int, up: Any = None) -> Any:
    """∫ |sin θ| cos(θ - γ) dθ from the eye's ray to an angle to one side, by its cosine and sine.

    γ is the angle of the projected normal, `tilt` its sine and `up` its cosine (else `sine`):
    (cos γ sin² θ ± sin γ (θ - sin θ cos θ)) / 2.
    """
    up = sine if up is None else up
    slope = dr.acos(dr.clip(cosine, -1, 1)) - sine * cosine
    return 0.5 * dr.fma(up, dr.square(sine), side * tilt * slope)
