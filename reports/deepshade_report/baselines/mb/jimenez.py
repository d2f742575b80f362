"""Jimenez's reconstruction filter for motion blur, on McGuire's dominant motions.

J. Jimenez: "Next Generation Post Processing in Call of Duty: Advanced Warfare", SIGGRAPH 2014
course "Advances in Real-Time Rendering", section on motion blur: taps come in pairs to both sides
of the pixel; where one side shows what is nearer and spreads farther, its weight counts for the
other too, which guesses what the foreground hides. The weights' mean is the share of the blur, the
pixel's own light fills the rest. Jittered look-ups of tiles and the alternation between the
dominant motion and the pixel's own are those of KinoMotion (K. Takahashi, MIT licence,
`Reconstruction.cginc`), the second after J.-P. Guertin, M. McGuire, D. Nowrouzezahrai: "A Fast and
Stable Feature-Aware Motion Blur Filter", HPG 2014.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.mb.tiles import STILL, Moving, dominant, upload
from deepshade_report.baselines.picture import Filter, gradient_noise, mi
from deepshade_report.tuning import Ranges, Tunable, tuned

SETTINGS = (4, 6, 8, 12, 18)  # pairs of taps, from cheap to best
QUICK = (6, 12)


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `extent` is the relative difference of depths over which nearer fades to farther. `jitter` is
    the share of a step over which taps are shifted at random, `wander` that of a tile by which
    its look-up is. From a ratio `own` of the pixel's velocity to the dominant one, every other pair
    goes along the pixel's own (1 or more: never). `tile` is the width of tiles, in pixels: spreads
    (half of a motion) are cut to it.
    """

    extent: float = 0.0625
    jitter: float = 1.0
    wander: float = 0.25
    own: float = 0.5
    tile: int = 32


PUBLISHED = Parameters()
RANGES: Ranges = {
    "extent": (0.002, 0.2),
    "jitter": (0.0, 1.0),
    "wander": (0.0, 0.5),
    "own": (0.0, 1.2),
    "tile": (16, 64),
}


def jimenez(pairs: int, parameters: Parameters | None = None) -> Filter:
    """The filter as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "jimenez"))
    return Filter("Jimenez", {"pairs": pairs}, parameters, upload, _shade, recorded=True)


TUNABLE = Tunable(partial(jimenez, 8), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The filter at its settings, from cheap to best; in a quick report, two of them."""
    return [jimenez(pairs) for pairs in (QUICK if quick else SETTINGS)]


def _shade(frame: Moving, pairs: int, *given: float) -> Any:
    numbers = [dr.opaque(mi.Float, float(value)) for value in given]
    return _gather(frame, dominant(frame, int(given[-1])), dr.opaque(mi.Int32, pairs), *numbers)


@dr.syntax
def _gather(
    frame: Moving,
    about: Any,
    pairs: Any,
    extent: Any,
    jitter: Any,
    wander: Any,
    own: Any,
    tile: Any,
) -> Any:
    u, v, speeds, tiles = about
    column, row = frame.grid.pixels()
    noise = gradient_noise(column, row)
    sin, cos = dr.sincos(gradient_noise(column + 2, row) * (2 * math.pi))
    place = tiles.at(
        mi.Int32(dr.floor(mi.Float(column) / tile + wander * cos)),
        mi.Int32(dr.floor(mi.Float(row) / tile + wander * sin)),
    )
    right, down, reach = (dr.gather(mi.Float, plane, place) for plane in (u, v, speeds))
    moving = reach > STILL

    spread, depth = dr.minimum(frame.speed, tile), frame.depth
    turn = frame.speed > own * reach  # the second direction, as long as the first
    stretch = reach / dr.maximum(frame.speed, STILL)
    second_right = dr.select(turn, frame.u * stretch, right)
    second_down = dr.select(turn, frame.v * stretch, down)

    weights, total = mi.Float(0), mi.Color3f(0)
    pair = mi.Int32(0)
    while (pair < pairs) & moving:
        t = (mi.Float(pair) + 0.5 + (noise - 0.5) * jitter) / mi.Float(pairs)
        odd = (pair & 1) == 1
        x, y = dr.select(odd, second_right, right) * t, dr.select(odd, second_down, down) * t
        distance = t * reach
        found = []
        for side in (1, -1):  # unrolled
            c = mi.Int32(dr.round(mi.Float(column) + side * x))
            r = mi.Int32(dr.round(mi.Float(row) + side * y))
            there = frame.grid.at(c, r)
            other = dr.minimum(dr.gather(mi.Float, frame.speed, there), tile)
            far = dr.gather(mi.Float, frame.depth, there)
            # the sample before the pixel, with its own spread; or behind it, with the pixel's
            ahead = dr.clip(0.5 + (depth - far) / (2 * extent * dr.minimum(depth, far)), 0, 1)
            covers, uncovers = (dr.clip(s - distance + 1, 0, 1) for s in (other, spread))
            weight = dr.lerp(uncovers, covers, ahead)
            found.append((weight, far, other, dr.gather(mi.Color3f, frame.light, there)))
        (first, first_far, first_spread, one), (second, second_far, second_spread, two) = found
        # mirroring: what is hidden behind the nearer, faster side looks like the opposite side
        behind, faster = first_far > second_far, second_spread > first_spread
        first, second = (
            dr.select(behind & faster, second, first),
            dr.select(behind | faster, second, first),
        )
        total += one * first + two * second
        weights += first + second
        pair += 1
    share = 1 / (2 * mi.Float(pairs))
    return dr.select(moving, total * share + frame.light * (1 - weights * share), frame.light)
