"""Direct light: the radiance that leaves any surface of a view after one bounce of its lights.

`leaving` is the one estimate that attributes and references share: a sample of each light with a
shadow ray, unbiased, wherever a ray meets a surface. A view's own `Light` counts alone, if there
is one; else the scene's emitters, or its default sun and sky with a lamp at the camera.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from deepshade.camera import Camera
from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair, split, strata
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, eye_of, material, normals_toward, offset_origin, trace
from deepshade_workers.view import Image, Light, Vector, View

mi = mitsuba()

# Irradiance of the camera's lamp on a surface that faces it at the view's median depth.
LAMP = 1.5
# Rays to a side of the picture that find the median depth.
COARSE = 64
# The end of rays to lights without a distance: the largest float32.
FARTHEST = float(np.finfo(np.float32).max)
# Streams of other references must not repeat here.
STREAM = 0x6C696768


@dataclass(frozen=True)
class Phong:
    """A surface in its shading frame: R_diff/π + R_spec (n + 2)/(2π) cosⁿα.

    α is the angle between the mirrored view and the light (normalised; Lafortune and Willems,
    "Using the modified Phong reflectance model", 1994).
    """

    frame: Any
    mirrored: Any
    diffuse: Any
    specular: Any
    gloss: Any

    @classmethod
    def at(cls, scene: Scene, view: View, surface: Any, valid: Any, ns: Any, toward: Any) -> Phong:
        """Evaluate the materials of `surface`, seen from the directions `toward`."""
        frame = mi.Frame3f(ns)
        return cls(
            frame,
            mi.reflect(frame.to_local(toward)),
            material(scene, view, surface, valid, "diffuse", 3),
            material(scene, view, surface, valid, "specular", 3),
            material(scene, view, surface, valid, "gloss", 1),
        )

    def shine(self, local: Any) -> Any:
        """The specular part of f for light from `local`."""
        return self.specular * (self.gloss + 2) * dr.inv_two_pi * self._lobe(local)

    def sample_shine(self, pair: Any) -> Any:
        """A local direction by the density (n + 1)/(2π) cosⁿα, for uniform `pair` in [0, 1)²."""
        cosine = dr.power(dr.maximum(1 - pair.x, 1e-7), 1 / (self.gloss + 1))
        sine = dr.safe_sqrt(1 - dr.square(cosine))
        side, front = dr.sincos(dr.two_pi * pair.y)
        return mi.Frame3f(self.mirrored).to_world(mi.Vector3f(sine * front, sine * side, cosine))

    def shine_density(self, local: Any) -> Any:
        """The density of `sample_shine` at `local`, per steradian."""
        return (self.gloss + 1) * dr.inv_two_pi * self._lobe(local)

    def _lobe(self, local: Any) -> Any:
        return dr.power(dr.maximum(dr.dot(local, self.mirrored), 1e-6), self.gloss)


@dataclass(frozen=True)
class Arriving:
    """A sample of a light: unit world `direction`, `distance`, `radiance` over its density."""

    direction: Any
    distance: Any
    radiance: Any


def prepare(scene: Scene, view: View) -> float:
    """Find what `leaving` must know of the whole view: the intensity of the camera's lamp, if any.

    Symbolic loops can't trace other rays than their own: call this before one that calls `leaving`.
    """
    if view.light is not None or scene.lit:
        return 0.0
    return _camera_lamp(scene, view.camera, view.camera.matrix.tobytes())


def leaving(
    scene: Scene,
    view: View,
    surface: Any,
    valid: Any,
    ng: Any,
    ns: Any,
    toward: Any,
    first: Any,
    second: Any,
) -> tuple[Any, Any]:
    """(diffuse part, all) of the radiance toward `toward`: Color3f, unbiased, of one light sample.

    `surface` are Mitsuba interactions of any rays, `valid` where there are some (elsewhere both
    are 0), `ng` and `ns` the geometric and shading normal on the seen side, `toward` unit world
    directions. `first` and `second` are uniform pairs in [0, 1)², for the lamp and the sky. The
    estimate has no noise where a point lamp alone is the light.
    """
    phong = Phong.at(scene, view, surface, valid, ns, toward)
    start = offset_origin(surface.p, ng, scene)
    part, whole = mi.Color3f(0), mi.Color3f(0)
    for light in _lights(scene, view, surface, valid, start, phong, first, second):
        local = phong.frame.to_local(light.direction)
        seen = valid & (local.z > 0) & (dr.max(light.radiance) > 0)
        reach = dr.select(light.distance < dr.inf, light.distance * (1 - 1e-4), FARTHEST)
        ray = mi.Ray3f(start, light.direction, reach, 0.0, [])
        seen &= ~scene.traced.ray_test(ray, seen)
        irradiance = dr.select(seen, light.radiance * local.z, 0)
        diffuse = phong.diffuse * dr.inv_pi * irradiance
        part += diffuse
        whole += diffuse + phong.shine(local) * irradiance
    return part, whole


def seen_along(scene: Scene, view: View, ray: Any, first: Any, second: Any) -> Any:
    """What `ray` meets as the pinhole would see it: L (Color3f) toward the eye, or the sky.

    `first` and `second` are as for `leaving`. The seen side of a surface is the ray's.
    """
    return seen_at(scene, view, ray, scene.traced.ray_intersect(ray), first, second)


def seen_at(scene: Scene, view: View, ray: Any, surface: Any, first: Any, second: Any) -> Any:
    """`seen_along` of a `ray` that meets `surface`, which may have moved since."""
    valid = surface.is_valid()
    ng, ns = normals_toward(surface, ray)
    toward = dr.normalize(eye_of(view.camera) - surface.p)
    _, whole = leaving(scene, view, surface, valid, ng, ns, toward, first, second)
    return dr.select(valid, whole, sky(scene, view, ray.d))


def sky(scene: Scene, view: View, direction: Any) -> Any:
    """Radiance (Color3f) that the eye sees in the unit world `direction` where nothing is.

    Without the sun's disc; black where the scene has no sky.
    """
    if view.light is not None:
        return _gradient(view.light, direction)
    environment = scene.traced.environment()
    if environment is None:
        return mi.Color3f(0)
    nothing = dr.zeros(mi.SurfaceInteraction3f)
    nothing.wi = -direction
    return environment.eval(nothing)


@dr.syntax
def direct_light(
    scene: Scene, view: View, hits: Hits, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """Radiance toward the camera after one bounce of the lights: L and its diffuse part L_diff.

    Both are (3, H, W), linear: means over about `samples` (`sampling.rays_used`) stratified
    samples of `leaving`. Where there is no surface L is the sky's radiance (0 if there is none)
    and L_diff is 0.
    """
    prepare(scene, view)
    columns, rows = strata(samples)
    cells = columns * rows
    stream = pixel_streams(len(hits.valid), seed ^ STREAM)
    toward = toward_camera(hits)
    wide = dr.opaque(mi.UInt32, columns)
    count = dr.opaque(mi.UInt32, 2 * cells)
    size = mi.Point2f(mi.Float(wide), mi.Float(dr.opaque(mi.UInt32, rows)))

    def sample(index: Any) -> tuple[Any, Any]:
        cell = index // 2
        corner = mi.Point2f(mi.Float(cell % wide), mi.Float(cell // wide))
        first = (corner + random_pair(stream, 2 * index)) / size
        second = (corner + random_pair(stream, 2 * index + 1)) / size
        return leaving(
            scene, view, hits.surface, hits.valid, hits.ng, hits.ns, toward, first, second
        )

    index = mi.UInt32(0)
    part = mi.Color3f(0)
    whole = mi.Color3f(0)
    while index < count:
        more, brighter = sample(index)
        part += more
        whole += brighter
        index += 1
    seen = sky(scene, view, -hits.surface.wi)  # where a ray hits nothing its wi is in the world
    light = dr.select(hits.valid, whole / (2 * cells), seen)
    part /= 2 * cells
    dr.eval(light, part)  # in one kernel: else every ray would be traced twice
    return hits.planar(light), hits.planar(part)


def toward_camera(hits: Hits) -> Any:
    """Unit world-space directions from the hits to the camera."""
    return hits.surface.to_world(hits.surface.wi)


def _lights(
    scene: Scene,
    view: View,
    surface: Any,
    valid: Any,
    start: Any,
    phong: Phong,
    first: Any,
    second: Any,
) -> list[Arriving]:
    if view.light is not None:
        light = view.light
        lamp = _lamp(light.position, light.size, light.intensity, start, first)
        return [lamp, _skylight(light, phong, second)]
    emitters = _emitters(scene, surface, valid, start, first)
    if scene.lit:
        return [emitters]
    # Closed rooms aren't black: what the camera sees, a lamp at the camera lights.
    x, y, z = view.camera.eye.tolist()
    intensity = prepare(scene, view)
    return [emitters, _lamp((x, y, z), 0.0, (intensity,) * 3, start, first)]


@functools.lru_cache(maxsize=4)
def _camera_lamp(scene: Scene, camera: Camera, place: bytes) -> float:
    """Radiant intensity of the camera's lamp; `place` is its matrix, which cameras don't compare.

    Planar depth is the median of what the whole frame sees; 0 where it sees nothing.
    """
    longest = max(camera.width, camera.height)
    width, height = (max(1, COARSE * n // longest) for n in (camera.width, camera.height))
    coarse = trace(scene, replace(camera, width=width, height=height, x0=0, y0=0), width, height)
    valid = coarse.valid.numpy()
    return LAMP * float(np.median(coarse.depth.numpy()[valid])) ** 2 if valid.any() else 0.0


def _emitters(scene: Scene, surface: Any, valid: Any, start: Any, pair: Any) -> Arriving:
    """One of the scene's own emitters, with what its choice and sampling divide by."""
    origin = mi.SurfaceInteraction3f(surface)
    origin.p = start
    light, radiance = scene.traced.sample_emitter_direction(origin, pair, False, valid)
    return Arriving(light.d, light.dist, dr.select(light.pdf > 0, radiance, 0))


def _lamp(position: Vector, size: float, intensity: Vector, start: Any, pair: Any) -> Arriving:
    """A sphere of uniform radiance, sampled over its solid angle; a point if `size` is 0.

    With d the distance of the centre and sin θ = size / d the radiance intensity / (π size²) over
    the density 1 / (2π (1 - cos θ)) is 2 intensity / (d² (1 + cos θ)): a point is its limit.
    Within the sphere it is as on its surface.
    """
    radius = dr.opaque(mi.Float, size)
    center = mi.Point3f(*(dr.opaque(mi.Float, x) for x in position)) - start
    distance = dr.maximum(dr.norm(center), dr.maximum(radius, 1e-18))  # its square isn't 0
    sine = dr.minimum(radius / distance, 1)
    cosine = dr.safe_sqrt(1 - sine * sine)
    disc = mi.warp.square_to_uniform_disk_concentric(pair)
    cap = sine * sine / (1 + cosine)  # 1 - cos θ, without cancellation
    down = cap * dr.squared_norm(disc)  # 1 - the sample's cosine
    across = dr.safe_sqrt(cap * (2 - down))
    local = mi.Vector3f(disc.x * across, disc.y * across, 1 - down)
    direction = mi.Frame3f(dr.normalize(center)).to_world(local)
    half = dr.safe_sqrt(dr.square(radius) - dr.square(distance) * down * (2 - down))
    near = distance * local.z - half
    brightness = mi.Color3f(*(dr.opaque(mi.Float, x) for x in intensity))
    return Arriving(direction, near, brightness * 2 / (dr.square(distance) * (1 + cosine)))


def _skylight(light: Light, phong: Phong, pair: Any) -> Arriving:
    """The sky, in a cosine-weighted direction or one of a glossy surface's lobe.

    Either counts by the density of the mixture (the balance heuristic: Veach and Guibas, 1995).
    Cosines alone would seldom find a narrow lobe, and then count for hundreds.
    """
    shine = dr.max(phong.specular)
    glossy = dr.select(shine > 0, shine / (shine + dr.max(phong.diffuse)), 0)
    shines, x = split(pair.x, glossy)
    pair = mi.Point2f(x, pair.y)
    local = mi.warp.square_to_cosine_hemisphere(pair)
    local = dr.select(shines, phong.sample_shine(pair), local)
    direction = phong.frame.to_world(local)
    density = dr.lerp(local.z * dr.inv_pi, phong.shine_density(local), glossy)
    radiance = dr.select(local.z > 0, _gradient(light, direction) / density, 0)
    return Arriving(direction, mi.Float(dr.inf), radiance)


def _gradient(light: Light, direction: Any) -> Any:
    """The sky's radiance: `horizon`, and with the square of the height more of the others."""
    zenith, horizon, ground = (
        mi.Color3f(*(dr.opaque(mi.Float, x) for x in colour))
        for colour in (light.zenith, light.horizon, light.ground)
    )
    end = dr.select(direction.y > 0, zenith, ground)
    return horizon + (end - horizon) * dr.square(direction.y)
