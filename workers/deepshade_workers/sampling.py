"""Random numbers of references: a hashed stream for each pixel, and strata.

Every pixel and sample draws from its own stream: a Tiny Encryption Algorithm hash of (pixel,
view seed) keys a second hash of the sample's index (Zafar, Olano and Curtis, "GPU Random Numbers
via the Tiny Encryption Algorithm", HPG 2010), so neighbours share no pattern.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba

mi = mitsuba()

# Of samples: more make an error more certain, fewer have more strata.
GROUPS = 8
_BELOW_1 = 1 - 2.0**-24  # the largest float32 that is


def random_pair(stream: Any, index: Any) -> Any:
    """Two floats in [0, 1) for sample `index` of each pixel's `stream`."""
    a, b = mi.sample_tea_32(stream, index, 6)
    scale = 2.0**-24
    return mi.Point2f(mi.Float(a >> 8) * scale, mi.Float(b >> 8) * scale)


def pixel_streams(count: int, seed: int) -> Any:
    """One hashed 32-bit stream key per pixel, from the view's seed.

    Two estimates of one view whose errors shall be independent need seeds that differ: `seed` ^ a
    constant of their own.
    """
    low, high = seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF
    index = dr.arange(mi.UInt32, count)
    key, _ = mi.sample_tea_32(index ^ dr.opaque(mi.UInt32, high), dr.opaque(mi.UInt32, low), 6)
    return key


def split(number: Any, share: Any) -> tuple[Any, Any]:
    """Whether uniform `number` in [0, 1) is below `share`, and what is left of it, uniform again.

    A choice made so keeps the strata of the number within each case. A number of the last stratum
    may have been rounded to 1: it is below a share of 1 all the same.
    """
    number = dr.minimum(number, _BELOW_1)
    chosen = number < share
    rest = dr.select(chosen, number / share, (number - share) / (1 - share))
    return chosen, dr.clip(rest, 0, _BELOW_1)


def strata(samples: int) -> tuple[int, int]:
    """Columns and rows of the grid whose cells hold two of about `samples` each.

    Exactly `samples` where that number factors into a grid no longer than 4:1, else a few less
    in a square one: strata in one dimension alone would double the error.
    """
    cells = max(1, samples // 2)
    side = math.isqrt(cells)
    for rows in range(side, 0, -1):
        if cells % rows == 0 and cells // rows <= 4 * rows:
            return cells // rows, rows
    return cells // side, side


def group_strata(samples: int) -> tuple[int, int]:
    """Columns and rows of the grid that each pair has in a group of `hypercube_mean`."""
    return strata(2 * max(1, samples // GROUPS))


def rays_used(samples: int) -> int:
    """How many rays a pixel a reference with `samples` asked for really takes."""
    columns, rows = strata(samples)
    return 2 * columns * rows


@dr.syntax
def stratified_mean(
    sample: Callable[[Any, Any, Any], Any],
    pixels: int,
    samples: int,
    seed: int,
    channels: int | None = None,
) -> tuple[Any, Any]:
    """Mean and standard error (Color3f each) of `sample(point, first, second)` for each pixel.

    With `channels`, ArrayXf of that many.

    The three are pairs in [0, 1)²: `point` has two jittered samples in each stratum of the square,
    about `samples` in all (`rays_used`), and the others are free. Each pair's difference gives an
    unbiased variance of its stratum's mean, hence of the whole, whatever else is random.
    """
    columns, rows = strata(samples)
    total = 2 * columns * rows
    stream = pixel_streams(pixels, seed)
    wide = dr.opaque(mi.UInt32, columns)
    count = dr.opaque(mi.UInt32, total)
    size = mi.Point2f(mi.Float(wide), mi.Float(dr.opaque(mi.UInt32, rows)))

    none = mi.Color3f(0) if channels is None else dr.zeros(mi.ArrayXf, (channels, pixels))
    index = mi.UInt32(0)
    mean = type(none)(none)
    squares = type(none)(none)
    before = type(none)(none)
    while index < count:
        cell = index // 2
        corner = mi.Point2f(mi.Float(cell % wide), mi.Float(cell // wide))
        point = (corner + random_pair(stream, 3 * index)) / size
        value = sample(
            point, random_pair(stream, 3 * index + 1), random_pair(stream, 3 * index + 2)
        )
        mean += value
        difference = dr.select((index & 1) == 1, value - before, 0)
        squares += difference * difference
        before = value
        index += 1
    found = mean / total, dr.sqrt(squares) / total
    dr.eval(found)  # in one kernel: one after the other they would trace every ray twice
    return found


@dr.syntax
def hypercube_mean(
    sample: Callable[[Any, Any, Any], Any], pixels: int, samples: int, seed: int
) -> tuple[Any, Any]:
    """`stratified_mean` where all three pairs matter: each has its own strata.

    Samples come in `GROUPS` groups. Within one, the strata of each pair are taken once, in an order
    of its own (Latin hypercube sampling: McKay, Beckman and Conover, Technometrics 21, 1979). The
    groups are independent, so that their spread gives an unbiased variance of the mean.
    """
    columns, rows = group_strata(samples)
    cells = columns * rows
    stream = pixel_streams(pixels, seed)
    wide = dr.opaque(mi.UInt32, columns)
    size = mi.Point2f(mi.Float(wide), mi.Float(dr.opaque(mi.UInt32, rows)))
    each = dr.opaque(mi.UInt32, cells)
    count = dr.opaque(mi.UInt32, GROUPS * cells)

    def pair(index: Any, which: int) -> Any:
        order, _ = mi.sample_tea_32(stream, ~(3 * (index // each) + which), 6)
        cell = mi.permute_kensler(index % each, cells, order)
        corner = mi.Point2f(mi.Float(cell % wide), mi.Float(cell // wide))
        return (corner + random_pair(stream, 3 * index + which)) / size

    index = mi.UInt32(0)
    group = mi.Color3f(0)
    mean = mi.Color3f(0)
    squares = mi.Color3f(0)  # of the groups' deviations from their mean (Welford, 1962)
    while index < count:
        group += sample(pair(index, 0), pair(index, 1), pair(index, 2)) / mi.Float(each)
        index += 1
        complete = index % each == 0
        deviation = dr.select(complete, group - mean, 0)
        mean += deviation / mi.Float(dr.maximum(index // each, 1))
        squares += deviation * dr.select(complete, group - mean, 0)
        group = dr.select(complete, 0, group)
    error = dr.sqrt(squares / (GROUPS * (GROUPS - 1)))
    dr.eval(mean, error)  # in one kernel
    return mean, error
