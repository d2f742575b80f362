"""Anti-aliasing: the light of a whole pixel.

Estimated with rays through stratified points of the pixel's square, each shaded where it hits
(`lighting.seen_along`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.lighting import prepare, seen_along
from deepshade_workers.sampling import hypercube_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, eye_of, pixel_rays, turn_to_world
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x61610001
# Fewer would leave steps that a reference mustn't have.
LEAST_SAMPLES = 64


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """The mean over each pixel's square (box filter) of L as shaded at each sample, at least 64.

    Returns (3, H, W) radiance and its standard error, of background too: sky is seen between.
    """
    prepare(scene, view)
    camera = view.camera
    centers = pixel_rays(camera, hits.width, hits.height)
    eye = eye_of(camera)
    wide = dr.opaque(mi.Float, 1 / camera.pixels_per_unit)
    high = dr.opaque(mi.Float, 1 / (camera.pixels_per_unit * camera.pixel_aspect))

    def within(point: Any, first: Any, second: Any) -> Any:
        offset = mi.Vector3f((point.x - 0.5) * wide, (point.y - 0.5) * high, 0)
        direction = dr.normalize(turn_to_world(camera, centers + offset))
        return seen_along(scene, view, mi.Ray3f(eye, direction), first, second)

    count = max(samples, LEAST_SAMPLES)
    value, error = hypercube_mean(within, len(hits.valid), count, seed ^ STREAM)
    return hits.planar(value), hits.planar(error)
