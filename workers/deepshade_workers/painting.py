"""Textures of scene files on the surfaces that rays meet.

Lookups are trilinear in box-filtered levels (Williams, "Pyramidal Parametrics", SIGGRAPH 1983); as
in `look`, the level follows from the pixel's footprint as the camera sees it, so that every ray
that comes to a place finds the same value there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade.camera import Camera, rotation_of
from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.bitmap import CLAMP, MAX_SIDE, MIRROR, REPEAT, Bitmap, levels

mi = mitsuba()

HALF: Any = dr.float16_array_t(mi.Float)
QUADRUPLE: Any = dr.float16_array_t(mi.Vector4f)
LEVELS = MAX_SIDE.bit_length()
# Texels of all textures, 16 bytes each: where there are more, the largest are halved.
BUDGET = 24_000_000
# The least cosine that a footprint is stretched by where a surface is seen at a grazing angle.
GRAZING = 0.1


@dataclass(frozen=True)
class Painting:
    """All bitmaps of a scene as Dr.Jit arrays; `mesh.Paint` says where they lie."""

    texels: Any  # every level of every bitmap: two quadruples of halves a texel
    places: Any  # (first texel, width, height) of each bitmap's `LEVELS` levels
    manners: Any  # (levels, wrap of u, wrap of v, nearest) of each bitmap
    coloured: bool

    @classmethod
    def of(cls, bitmaps: Sequence[Bitmap], coloured: bool) -> Painting:
        """`coloured` tells whether vertices have colours other than white."""
        pyramids = [levels(bitmap.texels) for bitmap in bitmaps]
        side = MAX_SIDE
        while side > 1 and sum(a.shape[0] * a.shape[1] for p in pyramids for a in p) > BUDGET:
            side //= 2
            pyramids = [[a for a in p if max(a.shape[:2]) <= side] for p in pyramids]
        places = np.zeros((len(bitmaps), LEVELS, 3), np.uint32)
        manners = np.zeros((len(bitmaps), 4), np.uint32)
        start = 0
        for number, (bitmap, pyramid) in enumerate(zip(bitmaps, pyramids, strict=True)):
            for index, level in enumerate(pyramid):
                height, width = level.shape[:2]
                places[number, index] = start, width, height
                start += width * height
            manners[number] = len(pyramid), *bitmap.wrap, bitmap.nearest
        flat = np.concatenate([level.ravel() for pyramid in pyramids for level in pyramid])
        return cls(
            HALF(flat),
            mi.UInt32(places.ravel()),
            mi.UInt32(manners.ravel()),
            coloured,
        )

    def term(self, surface: Any, camera: Camera, valid: Any, name: str) -> tuple[Any, Any]:
        """(where interactions have a texture, the Phong term `name` there).

        Color3f of "diffuse" and "specular", Float of "gloss".
        """
        number = surface.shape.eval_attribute_1("face_bitmap", surface, valid)
        valid = valid & (number >= 0)
        base, finish = self._texel(surface, camera, mi.UInt32(dr.maximum(number, 0)), valid)
        colour, metallic = mi.Color3f(base.x, base.y, base.z), base.w
        if self.coloured:
            colour *= surface.shape.eval_attribute_3("vertex_colour", surface, valid)
        if name == "diffuse":
            return valid, dr.clip(colour * (1 - metallic), 0, 1)
        if name == "specular":
            dielectric = mi.Color3f(finish.x, finish.y, finish.z)
            return valid, dr.clip(dr.lerp(dielectric, colour, metallic), 0, 1)
        alpha = dr.maximum(dr.square(finish.w), 0.03)  # as `bitmap.exponent`
        return valid, dr.maximum(2 / dr.square(alpha) - 2, 1)

    def _texel(self, surface: Any, camera: Camera, number: Any, valid: Any) -> tuple[Any, Any]:
        """(base colour and metallic, specular and roughness), Vector4f, of bitmap `number`."""
        manner = dr.gather(mi.Vector4u, self.manners, number, valid)
        finest = dr.gather(mi.Vector3u, self.places, number * LEVELS, valid)
        density = surface.shape.eval_attribute_1("face_density", surface, valid)
        area = mi.Float(finest.y) * mi.Float(finest.z)
        texels = _footprint(surface, camera) * density * dr.sqrt(area)
        last = mi.Float(manner.x) - 1
        level = dr.clip(dr.log2(dr.maximum(texels, 1e-6)), 0, last)
        fine = mi.UInt32(dr.minimum(level, dr.maximum(last - 1, 0)))
        blend = level - mi.Float(fine)
        coarse = dr.minimum(fine + 1, manner.x - 1)
        sharp = self._bilinear(surface.uv, number, fine, manner, valid)
        soft = self._bilinear(surface.uv, number, coarse, manner, valid)
        return dr.lerp(sharp[0], soft[0], blend), dr.lerp(sharp[1], soft[1], blend)

    def _bilinear(
        self, uv: Any, number: Any, level: Any, manner: Any, valid: Any
    ) -> tuple[Any, Any]:
        """Texels lie at the centres of their squares."""
        place = dr.gather(mi.Vector3u, self.places, number * LEVELS + level, valid)
        left, right, fx = _neighbours(uv.x, place.y, manner.y, manner.w)
        top, bottom, fy = _neighbours(uv.y, place.z, manner.z, manner.w)

        def at(row: Any, column: Any, half: int) -> Any:
            index = 2 * (place.x + row * place.y + column) + half
            return mi.Vector4f(dr.gather(QUADRUPLE, self.texels, index, valid))

        first, second = (
            dr.lerp(
                dr.lerp(at(top, left, half), at(top, right, half), fx),
                dr.lerp(at(bottom, left, half), at(bottom, right, half), fx),
                fy,
            )
            for half in (0, 1)
        )
        return first, second


def _neighbours(t: Any, size: Any, wrap: Any, nearest: Any) -> tuple[Any, Any, Any]:
    """The two texels of `size` that coordinate `t` lies between, and its share of the second."""
    mirrored = 1 - dr.abs(t - 2 * dr.floor(t / 2) - 1)
    within = dr.select(wrap == CLAMP, dr.clip(t, 0, 1), t - dr.floor(t))
    within = dr.select(wrap == MIRROR, mirrored, within)
    x = within * mi.Float(size) - 0.5
    low = dr.floor(x)
    share = x - low
    share = dr.select(nearest > 0, dr.select(share >= 0.5, 1.0, 0.0), share)
    first, last = mi.Int32(low), mi.Int32(size) - 1
    repeats = wrap == REPEAT
    before = dr.select(first < 0, dr.select(repeats, last, 0), dr.minimum(first, last))
    after = dr.select(first + 1 > last, dr.select(repeats, 0, last), first + 1)
    return mi.UInt32(before), mi.UInt32(after), share


def _footprint(surface: Any, camera: Camera) -> Any:
    """How wide a pixel of the camera is on the surface (the root of its area), scene units."""
    eye = mi.Point3f(*(dr.opaque(mi.Float, float(v)) for v in camera.eye))
    forward = mi.Vector3f(*(dr.opaque(mi.Float, float(-v)) for v in rotation_of(camera.matrix)[2]))
    toward = surface.p - eye
    depth = dr.maximum(dr.dot(toward, forward), 0)
    cosine = dr.abs(dr.dot(dr.normalize(toward), surface.n))
    pixel = dr.opaque(mi.Float, 1 / camera.pixels_per_unit)
    return depth * pixel / dr.sqrt(dr.maximum(cosine, GRAZING))
