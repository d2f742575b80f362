"""Rays: what each pixel's centre sees, and where rays that leave a surface start."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade.camera import Camera, rotation_of
from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.view import Image, View

mi = mitsuba()

# Offset of ray origins against self-intersection, relative to the larger of the scene's size and
# the point's coordinates: float32 resolves 2^-23 of them and intersection loses a few bits more.
ORIGIN_OFFSET = 2.0**-19
# The terms that textures of files say.
PAINTED = ("diffuse", "specular", "gloss")


@dataclass(frozen=True)
class Hits:
    """Per-pixel intersections, as Dr.Jit arrays in row-major order, world space.

    `p` position, `ng` geometric and `ns` shading normal (both on the camera's side of the
    surface), `depth` planar distance, `back` whether the surface was seen from behind,
    `surface` the full Mitsuba interaction.
    """

    width: int
    height: int
    valid: Any
    p: Any
    ng: Any
    ns: Any
    depth: Any
    back: Any
    surface: Any

    def planar(self, values: Any) -> Image:
        """(C, H, W) float32 of a Dr.Jit array with a value or colour for each pixel."""
        return np.asarray(values.numpy().reshape(-1, self.height, self.width), np.float32)


def trace(scene: Scene, camera: Camera, width: int, height: int) -> Hits:
    """Cast one ray through the centre of each of the `width` x `height` pixels of the window."""
    local = camera.rays(width, height).reshape(3, -1).astype(np.float64)
    length = np.linalg.norm(local, axis=0)
    world = rotation_of(camera.matrix).T @ (local / length)
    ray = mi.Ray3f(
        eye_of(camera),
        mi.Vector3f(*(mi.Float(row.astype(np.float32)) for row in world)),
    )
    si = scene.traced.ray_intersect(ray)
    valid = si.is_valid()
    back = valid & (dr.dot(si.n, ray.d) > 0)
    ng, ns = normals_toward(si, ray)
    depth = si.t / mi.Float(length.astype(np.float32))
    dr.eval(si, valid, ng, ns, depth, back)
    return Hits(width, height, valid, si.p, ng, ns, depth, back, si)


def eye_of(camera: Camera) -> Any:
    """The camera's place in world space."""
    return mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.eye))


def pixel_rays(camera: Camera, width: int, height: int) -> Any:
    """Camera-space directions with z = -1 through the centres of the window's pixels, row-major."""
    return mi.Vector3f(*(mi.Float(row) for row in camera.rays(width, height).reshape(3, -1)))


def turn_to_world(camera: Camera, vector: Any) -> Any:
    """A camera-space `vector` in world space."""
    x, y, z = (
        mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in axis))
        for axis in rotation_of(camera.matrix)
    )
    return x * vector.x + y * vector.y + z * vector.z


def normals_toward(surface: Any, ray: Any) -> tuple[Any, Any]:
    """Geometric and shading normal on the side that `ray` came from: surfaces have no inside."""
    ng = dr.select(dr.dot(surface.n, ray.d) > 0, -surface.n, surface.n)
    shading = surface.sh_frame.n
    return ng, dr.select(dr.dot(shading, ng) < 0, -shading, shading)


def offset_origin(point: Any, normal: Any, scene: Scene) -> Any:
    """Move `point` off its surface along the geometric `normal`, relative to magnitudes."""
    diagonal = dr.opaque(mi.Float, scene.diagonal)
    magnitude = dr.maximum(dr.max(dr.abs(point)), diagonal)
    return dr.fma(normal, magnitude * ORIGIN_OFFSET, point)


def material(scene: Scene, view: View, surface: Any, valid: Any, name: str, channels: int) -> Any:
    """A Phong term or the "object" number at interactions with a view's scene: 1 or 3 channels.

    `surface` is Mitsuba's interaction, `valid` where there is one. Our meshes carry the values per
    face or in textures, unless the view has a look. A Mitsuba XML scene's shapes tell only their
    diffuse reflectance; all else is 0.
    """
    shape = surface.shape
    if view.look is not None and view.look.holds(name):
        number = mi.UInt32(shape.eval_attribute_1("face_object", surface, valid))
        return dr.select(valid, view.look.term(surface, number, valid, name), 0)
    key = f"face_{name}"
    known = shape.has_attribute(key, valid)
    if channels == 1:
        value = dr.select(known, shape.eval_attribute_1(key, surface, known), 0)
    else:
        other = mi.Color3f(0)
        if name == "diffuse":
            other = surface.bsdf().eval_diffuse_reflectance(surface, valid)
        value = dr.select(known, shape.eval_attribute_3(key, surface, known), other)
    if scene.painting is not None and name in PAINTED:
        painted, term = scene.painting.term(surface, view.camera, valid, name)
        value = dr.select(painted, term, value)
    return value
