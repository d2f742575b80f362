"""Directional occlusion: the environment's light that nothing within a radius blocks.

Also which of many fixed directions are open, whatever the light (`directions`): the reference under
any map made of as many distant lamps, without noise.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from deepshade.camera import rotation_of
from deepshade.environments.lamps import DIRECTIONS
from deepshade_workers.backend import mitsuba
from deepshade_workers.environments import light_of
from deepshade_workers.references import Layer
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


def directions(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, None]:
    """Which of `deepshade.environments.lamps.DIRECTIONS`, in camera space, nothing blocks within R.

    Returns (64, H, W): 8 directions a plane, the first in the highest bit (as `np.unpackbits` takes
    them), 0 to 255. Those below a pixel's horizon count as blocked, and so do all of background.
    """
    origin = offset_origin(hits.p, hits.ng, scene)
    reach = dr.opaque(mi.Float, view.radius)
    planes = []
    for eight in (DIRECTIONS @ rotation_of(view.camera.matrix)).reshape(-1, 8, 3):
        bits = mi.UInt32(0)
        for direction in eight:
            toward = mi.Vector3f(*(dr.opaque(mi.Float, float(value)) for value in direction))
            valid = hits.valid & (dr.dot(toward, hits.ns) > 0)
            ray = mi.Ray3f(origin, toward, reach, 0.0, [])
            valid &= ~scene.traced.ray_test(ray, valid)
            bits = 2 * bits + dr.select(valid, mi.UInt32(1), mi.UInt32(0))
        planes.append(np.asarray(bits.numpy(), np.float32))
    return np.stack(planes).reshape(-1, hits.height, hits.width), None


LAYERS = {"directions": Layer(len(DIRECTIONS) // 8, directions, "uint8", exact=True)}
