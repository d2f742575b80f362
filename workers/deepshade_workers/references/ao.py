"""Monte Carlo references, one per effect, with their standard errors.

Every function takes the hits of `render.trace` and returns the estimate and its standard error.
Every pixel and sample draws from its own stream: a Tiny Encryption Algorithm hash of (pixel,
view seed) keys a second hash of the sample's index (Zafar, Olano and Curtis, "GPU Random Numbers
via the Tiny Encryption Algorithm", HPG 2010), so neighbours share no pattern.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.scene import Scene

mi = mitsuba()

Planes = NDArray[np.float32]

# Offset of ray origins against self-intersection, relative to the larger of the scene's size and
# the point's coordinates: float32 resolves 2^-23 of them and intersection loses a few bits more.
ORIGIN_OFFSET = 2.0**-19


def random_pair(stream: Any, index: Any) -> Any:
    """Two floats in [0, 1) for sample `index` of each pixel's `stream`."""
    a, b = mi.sample_tea_32(stream, index, 6)
    scale = 2.0**-24
    return mi.Point2f(mi.Float(a >> 8) * scale, mi.Float(b >> 8) * scale)


def pixel_streams(count: int, seed: int) -> Any:
    """One hashed 32-bit stream key per pixel, from the view's seed."""
    low, high = seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF
    index = dr.arange(mi.UInt32, count)
    key, _ = mi.sample_tea_32(index ^ dr.opaque(mi.UInt32, high), dr.opaque(mi.UInt32, low), 6)
    return key


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


def rays_used(samples: int) -> int:
    """How many rays a pixel a reference with `samples` asked for really takes."""
    columns, rows = strata(samples)
    return 2 * columns * rows


def offset_origin(point: Any, normal: Any, scene: Scene) -> Any:
    """Move `point` off its surface along the geometric `normal`, relative to magnitudes."""
    diagonal = dr.opaque(mi.Float, scene.diagonal)
    magnitude = dr.maximum(dr.max(dr.abs(point)), diagonal)
    return dr.fma(normal, magnitude * ORIGIN_OFFSET, point)


@dr.syntax
def ambient_occlusion(
    scene: Scene, hits: Any, *, radius: float, samples: int, seed: int
) -> tuple[Planes, Planes]:
    """(1/π)∫ V_R(ω) cosθ dω over the hemisphere about the shading normal; 1 is open.

    V_R is 1 when nothing blocks ω within `radius` (scene units). Cosine-weighted directions, two
    jittered samples in each of `samples`/2 strata: each pair's difference gives an unbiased
    variance of its stratum's mean, hence of the whole.

    Returns (1, N) visibility in [0, 1] and its standard error; pixels without a hit hold 1 and 0.
    """
    columns, rows = strata(samples)
    cells = columns * rows
    stream = pixel_streams(len(hits.valid), seed)
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    reach = dr.opaque(mi.Float, radius)
    traced = scene.traced
    wide = dr.opaque(mi.UInt32, columns)
    high = dr.opaque(mi.UInt32, rows)
    count = dr.opaque(mi.UInt32, cells)
    size = mi.Point2f(mi.Float(wide), mi.Float(high))

    def is_open(corner: Any, index: Any) -> Any:
        jittered = (corner + random_pair(stream, index)) / size
        local = mi.warp.square_to_cosine_hemisphere(jittered)
        ray = mi.Ray3f(origin, frame.to_world(local), reach, 0.0, [])
        return dr.select(traced.ray_test(ray, hits.valid), mi.UInt32(0), mi.UInt32(1))

    cell = mi.UInt32(0)
    total = mi.UInt32(0)
    differing = mi.UInt32(0)
    while cell < count:
        corner = mi.Point2f(mi.Float(cell % wide), mi.Float(cell // wide))
        first = is_open(corner, 2 * cell)
        second = is_open(corner, 2 * cell + 1)
        total += first + second
        differing += first ^ second
        cell += 1

    visibility = mi.Float(total) / (2 * cells)
    error = dr.sqrt(mi.Float(differing)) / (2 * cells)
    visibility = dr.select(hits.valid, visibility, 1)
    error = dr.select(hits.valid, error, 0)
    return visibility.numpy()[None], error.numpy()[None]


REFERENCES: dict[str, Callable[..., tuple[Planes, Planes]]] = {"ao": ambient_occlusion}
