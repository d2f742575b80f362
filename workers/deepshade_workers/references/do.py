"""Directional occlusion: the environment's light that nothing within a radius blocks."""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.environments import light_of
from deepshade_workers.sampling import split, stratified_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, offset_origin
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x646F0001


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """(1/π)∫ V_R(ω) L_env(ω) cosθ dω over the hemisphere about the shading normal.

    V_R is 1 when nothing blocks ω within the view's radius. Half of the rays leave in
    cosine-weighted directions, half in proportion to the environment's radiance; each counts by
    the density of the mixture (the balance heuristic: Veach and Guibas, "Optimally Combining
    Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995).

    Returns (3, H, W) radiance >= 0 and its standard error; background holds the environment's mean
    and 0.

    Raises:
        ConfigError: the view has no environment.
    """
    light = light_of(view, "do")
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    reach = dr.opaque(mi.Float, view.radius)

    def arriving(point: Any, first: Any, second: Any) -> Any:
        bright, x = split(point.x, 0.5)
        pair = mi.Point2f(x, point.y)
        local = mi.warp.square_to_cosine_hemisphere(pair)
        direction = dr.select(bright, light.sample(pair), frame.to_world(local))
        cosine = dr.dot(direction, hits.ns)
        valid = hits.valid & (cosine > 0)
        ray = mi.Ray3f(origin, direction, reach, 0.0, [])
        valid &= ~scene.traced.ray_test(ray, valid)
        lambert = cosine * dr.inv_pi
        density = (light.density(direction) + lambert) / 2
        return dr.select(valid, light.radiance(direction) * lambert / density, 0)

    value, error = stratified_mean(arriving, len(hits.valid), samples, seed ^ STREAM)
    value = dr.select(hits.valid, value, light.mean)
    return hits.planar(value), hits.planar(error)
