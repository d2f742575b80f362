"""Ambient occlusion."""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair, strata
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, offset_origin
from deepshade_workers.view import Image, Images, View

mi = mitsuba()


@dr.syntax
def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """(1/π)∫ V_R(ω) cosθ dω over the hemisphere about the shading normal; 1 is open.

    V_R is 1 when nothing blocks ω within the view's radius. Cosine-weighted directions, two
    jittered samples in each of `samples`/2 strata: each pair's difference gives an unbiased
    variance of its stratum's mean, hence of the whole.

    Returns (1, H, W) visibility in [0, 1] and its standard error; background holds 1 and 0.
    """
    columns, rows = strata(samples)
    cells = columns * rows
    stream = pixel_streams(len(hits.valid), seed)
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    reach = dr.opaque(mi.Float, view.radius)
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
    dr.eval(visibility, error)  # in one kernel: else every ray would be traced twice
    return hits.planar(visibility), hits.planar(error)
