"""Full shading: image-based light weighted by ambient occlusion, through a thin lens."""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.environments import light_of
from deepshade_workers.lighting import Phong
from deepshade_workers.references.dof import lens_ray
from deepshade_workers.references.ibl import reflected
from deepshade_workers.sampling import hypercube_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, eye_of, normals_toward, offset_origin, pixel_rays
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x66756C01


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """The mean over the lens of ibl · ao at what each lens ray of a pixel's centre sees.

    A surface keeps the ibl that it has toward the pinhole, on the side that the lens ray meets;
    where the ray leaves the scene it sees the environment. A closed lens (no aperture, or 0) gives
    ibl · ao. Each sample is one lens ray with one estimate of ibl and one, independent, of ao.

    Returns (3, H, W) radiance >= 0 and its standard error, of background too.

    Raises:
        ConfigError: the view has no environment.
    """
    light = light_of(view, "full")
    centers = pixel_rays(view.camera, hits.width, hits.height)
    eye = eye_of(view.camera)
    reach = dr.opaque(mi.Float, view.radius)

    def through_lens(point: Any, first: Any, second: Any) -> Any:
        ray = lens_ray(view, centers, mi.warp.square_to_uniform_disk_concentric(point))
        surface = scene.traced.ray_intersect(ray)
        valid = surface.is_valid()
        ng, ns = normals_toward(surface, ray)
        phong = Phong.at(scene, view, surface, valid, ns, dr.normalize(eye - surface.p))
        local = mi.warp.square_to_cosine_hemisphere(second)
        start = offset_origin(surface.p, ng, scene)
        blocked = scene.traced.ray_test(
            mi.Ray3f(start, phong.frame.to_world(local), reach, 0.0, []), valid
        )
        shaded = reflected(light, phong, valid & ~blocked, first)
        return dr.select(valid, shaded, light.radiance(ray.d))

    value, error = hypercube_mean(through_lens, len(hits.valid), samples, seed ^ STREAM)
    return hits.planar(value), hits.planar(error)
