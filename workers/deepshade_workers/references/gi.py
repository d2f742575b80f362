"""Indirect light of one bounce: how much diffuse direct light reaches a point from nearby.

Estimated with rays in cosine-weighted, stratified directions; where one meets a surface within the
radius, its shadowed diffuse light L_diff is itself a one-sample estimate (`lighting.leaving`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.lighting import leaving, prepare
from deepshade_workers.sampling import stratified_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, normals_toward, offset_origin
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x67690001


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """(1/π)∫ L_diff(hit of ω) cosθ dω over the hemisphere about the shading normal.

    Hits beyond the view's radius and the sky count as black; both faces of a surface reflect, and
    what the picture doesn't show counts as well.

    Returns (3, H, W) radiance >= 0 and its standard error; background holds 0 and 0.
    """
    prepare(scene, view)
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    reach = dr.opaque(mi.Float, view.radius)

    def gathered(point: Any, first: Any, second: Any) -> Any:
        direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(point))
        ray = mi.Ray3f(origin, direction, reach, 0.0, [])
        surface = scene.traced.ray_intersect(ray, hits.valid)
        valid = surface.is_valid()
        ng, ns = normals_toward(surface, ray)
        part, _ = leaving(scene, view, surface, valid, ng, ns, -direction, first, second)
        return part

    value, error = stratified_mean(gathered, len(hits.valid), samples, seed ^ STREAM)
    return hits.planar(value), hits.planar(error)
