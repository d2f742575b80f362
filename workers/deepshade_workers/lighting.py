"""Direct light at the primary hits: what screen-space effects of light start from."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .backend import mitsuba
from .reference import offset_origin, pixel_streams, random_pair
from .scene import Scene
from .trace import Hits, material

mi = mitsuba()

# Irradiance of the camera's lamp on a surface that faces it at the view's median depth.
LAMP = 1.5
# Streams of other references must not repeat here.
STREAM = 0x6C696768


@dr.syntax
def direct_light(
    scene: Scene, hits: Hits, *, samples: int, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Radiance toward the camera after one bounce of the lights: L and its diffuse part L_diff.

    Both are (3, N), linear. The surface is Phong's: diffuse R_diff/π, and R_spec (n + 2)/(2π)
    cosⁿα with α between the mirrored view and the light (normalised; Lafortune and Willems 1994).
    A scene without lights of its own has the default sun and sky, and a lamp at the camera so
    that closed rooms aren't black. Pixels without a hit hold 0.
    """
    stream = pixel_streams(len(hits.valid), seed ^ STREAM)
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    diffuse = material(hits, "diffuse", 3)
    specular = material(hits, "specular", 3)
    gloss = material(hits, "gloss", 1)
    mirrored = mi.reflect(frame.to_local(hits.surface.to_world(hits.surface.wi)))
    reference = mi.SurfaceInteraction3f(hits.surface)
    reference.p = origin
    traced, valid = scene.traced, hits.valid
    count = dr.opaque(mi.UInt32, samples)

    index = mi.UInt32(0)
    lit = mi.Color3f(0)
    shone = mi.Color3f(0)
    while index < count:
        light, radiance = traced.sample_emitter_direction(
            reference, random_pair(stream, index), False, valid
        )
        local = frame.to_local(light.d)
        seen = valid & (light.pdf > 0) & (local.z > 0)
        reach = dr.select(light.dist < dr.inf, light.dist * (1 - 1e-4), dr.largest(mi.Float))
        ray = mi.Ray3f(origin, light.d, reach, 0.0, [])
        seen &= ~traced.ray_test(ray, seen)
        arriving = dr.select(seen, radiance * local.z, 0)
        lobe = dr.power(dr.maximum(dr.dot(local, mirrored), 1e-6), gloss)
        lit += diffuse * dr.inv_pi * arriving
        shone += specular * (gloss + 2) * dr.inv_two_pi * lobe * arriving
        index += 1

    part = lit / samples
    whole = part + shone / samples
    if not scene.lit and dr.any(valid):
        # No shadow ray: whatever the camera sees, a lamp at the camera lights.
        local = frame.to_local(hits.surface.to_world(hits.surface.wi))
        median = float(np.median(hits.depth.numpy()[valid.numpy()]))
        arriving = LAMP * dr.square(median / hits.surface.t) * dr.maximum(local.z, 0)
        lobe = dr.power(dr.maximum(dr.dot(local, mirrored), 1e-6), gloss)
        part += diffuse * dr.inv_pi * arriving
        whole += (diffuse * dr.inv_pi + specular * (gloss + 2) * dr.inv_two_pi * lobe) * arriving
    return _image(whole, hits), _image(part, hits)


def _image(colour: Any, hits: Hits) -> NDArray[np.float32]:
    return np.asarray(dr.select(hits.valid, colour, 0).numpy(), np.float32)
