"""Image-based lighting: an environment reflected by an unblocked Phong surface."""

from __future__ import annotations

from typing import Any

import drjit as dr

from deepshade_workers.backend import mitsuba
from deepshade_workers.environments import EnvironmentLight, light_of
from deepshade_workers.lighting import Phong, toward_camera
from deepshade_workers.sampling import split, stratified_mean
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

STREAM = 0x69626C01


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """∫ f_Phong(ω) L_env(ω) cosθ dω over the hemisphere about the shading normal, unblocked.

    f is that of direct light (`lighting.Phong`), from the surface's own diffuse and specular
    reflectance and gloss.

    Returns (3, H, W) radiance >= 0 and its standard error; background holds the environment along
    the view and 0.

    Raises:
        ConfigError: the view has no environment.
    """
    light = light_of(view, "ibl")
    toward = toward_camera(hits)
    phong = Phong.at(scene, view, hits.surface, hits.valid, hits.ns, toward)

    def arriving(point: Any, first: Any, second: Any) -> Any:
        return reflected(light, phong, hits.valid, point)

    value, error = stratified_mean(arriving, len(hits.valid), samples, seed ^ STREAM)
    behind = light.radiance(-hits.surface.wi)  # where a ray hits nothing its wi is in the world
    value = dr.select(hits.valid, value, behind)
    return hits.planar(value), hits.planar(error)


def reflected(light: EnvironmentLight, phong: Phong, valid: Any, point: Any) -> Any:
    """One estimate of ∫ f L_env cosθ dω (Color3f), for uniform `point` in [0, 1)²; unbiased.

    Half of all directions are drawn in proportion to the environment's radiance, the others by the
    two parts of f; each counts by the density of the mixture (the balance heuristic: Veach and
    Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995).
    """
    shine, matte = dr.mean(phong.specular), dr.mean(phong.diffuse)
    share = dr.select(shine > 0, shine / (shine + matte), 0)
    bright, x = split(point.x, 0.5)
    glossy, narrow = split(x, share)
    pair = mi.Point2f(narrow, point.y)
    own = dr.select(glossy, phong.sample_shine(pair), mi.warp.square_to_cosine_hemisphere(pair))
    other = phong.frame.to_local(light.sample(mi.Point2f(x, point.y)))
    local = dr.select(bright, other, own)
    direction = phong.frame.to_world(local)
    parts = dr.lerp(local.z * dr.inv_pi, phong.shine_density(local), share)
    density = (light.density(direction) + parts) / 2
    # A narrow lobe's density may underflow, and f with it.
    valid = valid & (local.z > 0) & (density > 0)
    f = phong.diffuse * dr.inv_pi + phong.shine(local)
    return dr.select(valid, f * light.radiance(direction) * local.z / density, 0)
