"""Depth of field of a thin lens.

Estimated with rays from stratified points of a round lens; what each meets is shaded as the
pinhole sees it (`lighting.seen_along`), so that the blur is of the picture's own light.
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

STREAM = 0x646F6601


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """The mean over the lens of L at what each lens ray of a pixel's centre sees.

    A surface keeps the L that it has toward the pinhole, on the side that the lens ray meets; the
    sky is seen in the lens ray's direction. A closed lens (no aperture, or 0) gives L.

    Returns (3, H, W) radiance and its standard error, of background too.
    """
    prepare(scene, view)
    centers = pixel_rays(view.camera, hits.width, hits.height)

    def through_lens(point: Any, first: Any, second: Any) -> Any:
        disc = mi.warp.square_to_uniform_disk_concentric(point)
        return seen_along(scene, view, lens_ray(view, centers, disc), first, second)

    value, error = hypercube_mean(through_lens, len(hits.valid), samples, seed ^ STREAM)
    return hits.planar(value), hits.planar(error)


def lens_ray(view: View, center: Any, disc: Any) -> Any:
    """The world-space ray that leaves the lens at `disc`, a point of the unit disc.

    `center` is the pixel's camera-space direction with z = -1. The lens lies about the eye in the
    camera's x-y plane, `view.aperture` across; the ray crosses the pixel's centre ray at the
    planar depth `view.focus`.
    """
    radius, nearness = 0.0, 0.0
    if view.aperture is not None and view.focus is not None:
        radius, nearness = view.aperture / 2, 1 / view.focus
    lens = mi.Vector3f(disc.x, disc.y, 0) * dr.opaque(mi.Float, radius)
    direction = center - lens * dr.opaque(mi.Float, nearness)
    camera = view.camera
    origin = eye_of(camera) + turn_to_world(camera, lens)
    return mi.Ray3f(origin, dr.normalize(turn_to_world(camera, direction)))
