"""Motion blur of objects that move along straight lines while the shutter is open.

Estimated with rays at stratified times. A moving object is traced where it is in the middle of the
exposure, with the ray moved back instead, so that what is hit is shaded as it is in the middle.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.lighting import prepare, seen_at
from deepshade_workers.sampling import group_strata, hypercube_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, eye_of, pixel_rays, turn_to_world
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x6D620001


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """The mean over the exposure of L at what each pixel's centre sees, time being uniform.

    At the time t in [-½, ½] an object is displaced by t times its `view.displacements`. A surface
    keeps the L that it has in the middle, shadows too, on the side that is seen at t.

    Returns (3, H, W) radiance and its standard error, of background too: sky is uncovered.

    Raises:
        SceneError: the view moves an object that the scene doesn't have.
    """
    prepare(scene, view)
    parts = [
        (traced, mi.Vector3f(*(dr.opaque(mi.Float, x) for x in move)))
        for traced, move in scene.moving_parts(view.displacements)
    ]
    eye = eye_of(view.camera)
    centers = pixel_rays(view.camera, hits.width, hits.height)
    direction = dr.normalize(turn_to_world(view.camera, centers))
    rows = dr.opaque(mi.Float, group_strata(samples)[1])

    def at_a_time(point: Any, first: Any, second: Any) -> Any:
        # Rows after one another make of the square's strata as many of time.
        row = dr.minimum(dr.floor(point.y * rows), rows - 1)
        time = (row + point.x) / rows - 0.5
        surface = dr.zeros(mi.SurfaceInteraction3f)
        surface.t = mi.Float(dr.inf)
        for traced, move in parts:
            found = traced.ray_intersect(mi.Ray3f(eye - time * move, direction))
            surface = dr.select(found.t < surface.t, found, surface)
        return seen_at(scene, view, mi.Ray3f(eye, direction), surface, first, second)

    value, error = hypercube_mean(at_a_time, len(hits.valid), samples, seed ^ STREAM)
    return hits.planar(value), hits.planar(error)
