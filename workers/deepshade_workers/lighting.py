"""Direct light at the primary hits: what screen-space effects of light start from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, material, offset_origin
from deepshade_workers.view import Image

mi = mitsuba()

# Irradiance of the camera's lamp on a surface that faces it at the view's median depth.
LAMP = 1.5
# The end of rays to lights without a distance: the largest float32.
FARTHEST = float(np.finfo(np.float32).max)
# Streams of other references must not repeat here.
STREAM = 0x6C696768


@dataclass(frozen=True)
class Phong:
    """The surface at the hits, in its shading frame: R_diff/π + R_spec (n + 2)/(2π) cosⁿα.

    α is the angle between the mirrored view and the light (normalised; Lafortune and Willems,
    "Using the modified Phong reflectance model", 1994).
    """

    frame: Any
    mirrored: Any
    diffuse: Any
    specular: Any
    gloss: Any

    @classmethod
    def at(cls, scene: Scene, hits: Hits) -> Phong:
        """Evaluate the materials of `hits`."""
        frame = mi.Frame3f(hits.ns)
        return cls(
            frame,
            mi.reflect(frame.to_local(toward_camera(hits))),
            material(scene, hits.surface, hits.valid, "diffuse", 3),
            material(scene, hits.surface, hits.valid, "specular", 3),
            material(scene, hits.surface, hits.valid, "gloss", 1),
        )

    def shine(self, local: Any) -> Any:
        """The specular part toward the camera for light from `local`."""
        lobe = dr.power(dr.maximum(dr.dot(local, self.mirrored), 1e-6), self.gloss)
        return self.specular * (self.gloss + 2) * dr.inv_two_pi * lobe


def direct_light(scene: Scene, hits: Hits, *, samples: int, seed: int) -> tuple[Image, Image]:
    """Radiance toward the camera after one bounce of the lights: L and its diffuse part L_diff.

    Both are (3, H, W), linear. Where there is no surface L is the sky's radiance (without the
    sun's disc; 0 if the scene has no sky) and L_diff is 0. A scene without lights of its own has
    the default sun and sky, and a lamp at the camera so that closed rooms aren't black.
    """
    phong = Phong.at(scene, hits)
    part, shone = _sample_lights(scene, hits, phong, samples, seed)
    if not scene.lit and hits.valid.numpy().any():
        # No shadow ray: whatever the camera sees, a lamp at the camera lights.
        local = phong.frame.to_local(toward_camera(hits))
        median = float(np.median(hits.depth.numpy()[hits.valid.numpy()]))
        arriving = LAMP * dr.square(median / hits.surface.t) * dr.maximum(local.z, 0)
        part += phong.diffuse * dr.inv_pi * arriving
        shone += phong.shine(local) * arriving
    sky = scene.traced.environment()
    seen = mi.Color3f(0) if sky is None else sky.eval(hits.surface, ~hits.valid)
    light = dr.select(hits.valid, part + shone, seen)
    return hits.planar(light), hits.planar(dr.select(hits.valid, part, 0))


def toward_camera(hits: Hits) -> Any:
    """Unit world-space directions from the hits to the camera."""
    return hits.surface.to_world(hits.surface.wi)


@dr.syntax
def _sample_lights(
    scene: Scene, hits: Hits, phong: Phong, samples: int, seed: int
) -> tuple[Any, Any]:
    """Mean diffuse and specular radiance over `samples` light samples with shadow rays."""
    stream = pixel_streams(len(hits.valid), seed ^ STREAM)
    start = mi.SurfaceInteraction3f(hits.surface)
    start.p = offset_origin(hits.p, hits.ng, scene)
    traced, valid, frame = scene.traced, hits.valid, phong.frame
    count = dr.opaque(mi.UInt32, samples)

    def lights(index: Any) -> tuple[Any, Any]:
        light, radiance = traced.sample_emitter_direction(
            start, random_pair(stream, index), False, valid
        )
        local = frame.to_local(light.d)
        seen = valid & (light.pdf > 0) & (local.z > 0)
        reach = dr.select(light.dist < dr.inf, light.dist * (1 - 1e-4), FARTHEST)
        ray = mi.Ray3f(start.p, light.d, reach, 0.0, [])
        seen &= ~traced.ray_test(ray, seen)
        arriving = dr.select(seen, radiance * local.z, 0)
        return phong.diffuse * dr.inv_pi * arriving, phong.shine(local) * arriving

    index = mi.UInt32(0)
    part = mi.Color3f(0)
    shone = mi.Color3f(0)
    while index < count:
        more, brighter = lights(index)
        part += more
        shone += brighter
        index += 1
    return part / samples, shone / samples
