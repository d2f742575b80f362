"""Primary hits: what each pixel's centre sees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera, rotation_of
from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.scene import MATERIAL_CHANNELS, Scene

mi = mitsuba()


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


def trace(scene: Scene, camera: Camera, width: int, height: int) -> Hits:
    """Cast one ray through the centre of each of the `width` x `height` pixels of the window."""
    local = camera.rays(width, height).reshape(3, -1).astype(np.float64)
    length = np.linalg.norm(local, axis=0)
    world = rotation_of(camera.matrix).T @ (local / length)
    eye = camera.eye
    ray = mi.Ray3f(
        mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in eye)),
        mi.Vector3f(*(mi.Float(row.astype(np.float32)) for row in world)),
    )
    si = scene.traced.ray_intersect(ray)
    valid = si.is_valid()
    back = valid & (dr.dot(si.n, ray.d) > 0)
    # Both normals face the camera: surfaces have no inside for a G-buffer.
    ng = dr.select(back, -si.n, si.n)
    shading = si.sh_frame.n
    ns = dr.select(dr.dot(shading, ng) < 0, -shading, shading)
    depth = si.t / mi.Float(length.astype(np.float32))
    dr.eval(si, valid, ng, ns, depth, back)
    return Hits(width, height, valid, si.p, ng, ns, depth, back, si)


def attributes(hits: Hits, camera: Camera) -> dict[str, NDArray[np.float32]]:
    """`position`, `normal`, `depth` and the Phong material of `hits`, planar (C, H, W).

    Background pixels hold 0, but infinite depth.
    """
    valid = hits.valid.numpy()
    depth = np.where(valid, hits.depth.numpy(), np.inf).reshape(1, hits.height, hits.width)
    rays = camera.rays(hits.width, hits.height)
    normal = rotation_of(camera.matrix) @ hits.ns.numpy().astype(np.float64)
    result = {
        "position": rays * np.where(valid.reshape(depth.shape), depth, 0),
        "normal": _planar(np.where(valid, normal, 0), hits),
        "depth": depth,
    }
    for name, (start, stop) in MATERIAL_CHANNELS.items():
        result[name] = _planar(material(hits, name, stop - start).numpy() * valid, hits)
    return {name: np.ascontiguousarray(value, np.float32) for name, value in result.items()}


def material(hits: Hits, name: str, channels: int) -> Any:
    """A Phong term at the hits, as a Dr.Jit array of 1 or 3 channels.

    Our meshes carry it per face. A Mitsuba XML scene's shapes tell only their diffuse
    reflectance; their other terms are 0.
    """
    shape, si = hits.surface.shape, hits.surface
    key = f"face_{name}"
    known = shape.has_attribute(key, hits.valid)
    if channels == 1:
        return dr.select(known, shape.eval_attribute_1(key, si, known), 0)
    other = mi.Color3f(0)
    if name == "diffuse":
        other = si.bsdf().eval_diffuse_reflectance(si, hits.valid)
    return dr.select(known, shape.eval_attribute_3(key, si, known), other)


def _planar(values: NDArray[np.float32], hits: Hits) -> NDArray[np.float32]:
    return values.reshape(-1, hits.height, hits.width)
