"""Looks: textures and Phong terms drawn for the objects of a scene, in place of its own.

A texture lies on an object by box mapping: the side that the geometric normal points to most says
from which axis it is projected. Lookups are trilinear in box-filtered levels (Williams, "Pyramidal
Parametrics", SIGGRAPH 1983); the level follows from the pixel's footprint as the camera sees it, so
that every ray that comes to a place, through a lens or after a bounce, finds the same value there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera, rotation_of
from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.textures import SIDE, Texture, draw_textures
from deepshade_workers.view import LookRecord, Vector

mi = mitsuba()

Floats = NDArray[np.float64]

# The most textures of one view: objects share them, each in its own tint, scale, turn and place.
TEXTURES = 8
PLAIN_SHARE = 0.25
METAL_SHARE = 0.12
# A texture's repeat relative to the view's median depth: 40 to 500 pixels of a 512-pixel frame.
REPEATS = (0.08, 0.9)
# The least cosine that a footprint is stretched by where a surface is seen at a grazing angle.
GRAZING = 0.1
LEVELS = SIDE.bit_length()  # 256², 128², ..., 1²


@dataclass(frozen=True)
class Look:
    """Materials by object number, as Dr.Jit arrays; `record` makes the same ones again."""

    record: LookRecord
    texels: Any  # every texture's levels, one after the other, the finest first
    layer: Any  # the object's texture; `TEXTURES` where it is plain
    tint: Any
    across: Any  # the texture's u axis in the side's plane, repeats a unit: (cos, sin) · repeats
    offset: Any
    specular: Any
    gloss: Any
    scatter: Any
    eye: Any
    forward: Any
    pixel: Any  # a pixel's width at depth 1

    @classmethod
    def draw(cls, scene: Scene, camera: Camera, record: LookRecord) -> Look:
        """The look that `record` stands for, of the objects of `scene` seen by `camera`."""
        rng = np.random.default_rng(record.seed)
        count = max(1, len(scene.objects))
        kinds = min(TEXTURES, count)
        textures = [] if record.own else draw_textures(rng, kinds, record.textures)
        plain = rng.random(count) < PLAIN_SHARE
        layer = np.where(plain, TEXTURES, rng.integers(kinds, size=count))
        tint, specular, gloss = _phong(rng, plain)
        repeats = 1 / (
            record.length * np.exp(rng.uniform(np.log(REPEATS[0]), np.log(REPEATS[1]), count))
        )
        turns = np.where(
            rng.random(count) < 0.7, rng.integers(4, size=count), rng.uniform(0, 4, count)
        )
        across = repeats * np.stack([np.cos(turns * np.pi / 2), np.sin(turns * np.pi / 2)])
        offset = rng.random((2, count))
        scatter = np.zeros((3, count))
        for number, item in enumerate(scene.objects):
            scatter[:, number] = record.scatter.get(item.name, (0.0, 0.0, 0.0))
        forward = -rotation_of(camera.matrix)[2]
        return cls(
            record,
            mi.Float(np.concatenate([np.zeros(0, np.float32), *map(_levels, textures)])),
            mi.UInt32(layer.astype(np.uint32)),
            mi.Color3f(tint.astype(np.float32)),
            mi.Vector2f(across.astype(np.float32)),
            mi.Vector2f(offset.astype(np.float32)),
            mi.Color3f(specular.astype(np.float32)),
            mi.Float(gloss.astype(np.float32)),
            mi.Color3f(scatter.astype(np.float32)),
            mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.eye)),
            mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in forward)),
            dr.opaque(mi.Float, 1 / camera.pixels_per_unit),
        )

    def holds(self, name: str) -> bool:
        """Whether the look has the term `name`, in place of the scene's own."""
        return name == "scatter" or (
            name in ("diffuse", "specular", "gloss") and not self.record.own
        )

    def term(self, surface: Any, number: Any, valid: Any, name: str) -> Any:
        """The term `name` (Color3f, gloss Float) at interactions with objects `number` (UInt32)."""
        if name == "gloss":
            return dr.gather(mi.Float, self.gloss, number, valid)
        if name != "diffuse":
            return dr.gather(mi.Color3f, getattr(self, name), number, valid)
        tint = dr.gather(mi.Color3f, self.tint, number, valid)
        layer = dr.gather(mi.UInt32, self.layer, number, valid)
        textured = valid & (layer < TEXTURES)
        return dr.select(textured, tint * self._texel(surface, number, layer, textured), tint)

    def _texel(self, surface: Any, number: Any, layer: Any, valid: Any) -> Any:
        p, n = surface.p, dr.abs(surface.n)
        sideways = (n.x >= n.y) & (n.x >= n.z)
        upright = ~sideways & (n.y >= n.z)
        u = dr.select(sideways, p.z, p.x)
        v = dr.select(upright, p.z, -p.y)
        across = dr.gather(mi.Vector2f, self.across, number, valid)
        offset = dr.gather(mi.Vector2f, self.offset, number, valid)
        x = across.x * u + across.y * v + offset.x
        y = across.x * v - across.y * u + offset.y
        # The footprint's size: the root of its area in texels.
        toward = p - self.eye
        depth = dr.maximum(dr.dot(toward, self.forward), 0)
        cosine = dr.abs(dr.dot(dr.normalize(toward), surface.n))
        texels = depth * self.pixel * dr.norm(across) * SIDE / dr.sqrt(dr.maximum(cosine, GRAZING))
        level = dr.clip(dr.log2(dr.maximum(texels, 1e-6)), 0, LEVELS - 1.001)
        fine = mi.UInt32(level)
        blend = level - mi.Float(fine)
        return dr.lerp(
            self._bilinear(x, y, layer, fine, valid),
            self._bilinear(x, y, layer, fine + 1, valid),
            blend,
        )

    def _bilinear(self, x: Any, y: Any, layer: Any, level: Any, valid: Any) -> Any:
        """Texels lie at the centres of their squares and repeat."""
        side = mi.UInt32(SIDE) >> level
        # The finer levels hold (4 SIDE² - 4 side²) / 3 texels.
        start = layer * _TEXELS + ((mi.UInt32(SIDE * SIDE) - side * side) * 4) // 3
        x, y = (x - dr.floor(x)) * side - 0.5, (y - dr.floor(y)) * side - 0.5
        left, top = dr.floor(x), dr.floor(y)
        fx, fy = x - left, y - top
        # Powers of two repeat by masking, -1 too.
        column, row = mi.UInt32(mi.Int32(left)), mi.UInt32(mi.Int32(top))

        def at(down: int, right: int) -> Any:
            place = ((row + down) & (side - 1)) * side + ((column + right) & (side - 1))
            return dr.gather(mi.Color3f, self.texels, start + place, valid)

        return dr.lerp(dr.lerp(at(0, 0), at(0, 1), fx), dr.lerp(at(1, 0), at(1, 1), fx), fy)


_TEXELS = (4 * SIDE * SIDE - 1) // 3  # of a texture's levels


def _levels(texture: Texture) -> NDArray[np.float32]:
    """A (SIDE, SIDE, 3) texture and its box-filtered levels down to one texel, flat."""
    levels = [texture]
    while len(levels[-1]) > 1:
        half = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(half, 2, half, 2, 3).mean((1, 3)))
    return np.concatenate([level.astype(np.float32).ravel() for level in levels])


def _phong(rng: np.random.Generator, plain: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Tint (3, n), specular reflectance (3, n) and exponent (n,); diffuse + specular stay below 1.

    Textures bring their own colours: their tints are pale. Some objects are metal, many matte.
    """
    count = len(plain)
    hue = 1 - rng.uniform(0, np.where(plain, 0.8, 0.35), count) * rng.random((3, count))
    tint = hue * np.where(plain, rng.uniform(0.1, 0.9, count), rng.uniform(0.6, 1.0, count))
    metal = rng.random(count) < METAL_SHARE
    shine = np.where(rng.random(count) < 0.4, 0.0, rng.uniform(0.02, 0.2, count))
    specular = np.where(metal, hue * rng.uniform(0.4, 0.8, count), shine)
    tint = tint * np.where(metal, rng.uniform(0.02, 0.2, count), 1 - shine)
    return tint, specular, np.exp2(rng.uniform(1, 10, count))


def mean_free_path(
    rng: np.random.Generator, depth: float, pixels_per_unit: float, most: float
) -> Vector:
    """Of a scattering object at `depth`: half a pixel to `most` pixels, scene units.

    Red gets farthest in half of them, as in skin; in the others all colours get as far.
    """
    longest = np.exp(rng.uniform(np.log(0.5), np.log(max(most, 0.5)))) * depth / pixels_per_unit
    green = rng.uniform(0.25, 0.7)
    shares = (1.0, green, green * rng.uniform(0.4, 0.9)) if rng.random() < 0.5 else (1.0, 1.0, 1.0)
    return tuple(float(longest * share) for share in shares)  # type: ignore[return-value]


def scattering(
    rng: np.random.Generator,
    depths: Mapping[str, float],
    pixels_per_unit: float,
    most: float,
    share: float = 0.5,
) -> dict[str, Vector]:
    """Mean free paths of about `share` of the visible objects, by name, from their `depths`."""
    return {
        name: mean_free_path(rng, depth, pixels_per_unit, most)
        for name, depth in depths.items()
        if rng.random() < share
    }
