"""Textures of scene files: texels of what a surface reflects, and the pictures they come from."""

from __future__ import annotations

import functools
import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from deepshade_workers.scenes.mesh import Floats, Material

# Larger pictures are averaged down to this side: a texel is then below a pixel of most frames.
MAX_SIDE = 1024
DIELECTRIC = 0.04
WHITE = (1.0, 1.0, 1.0)
# What happens beyond a picture's edges.
REPEAT, MIRROR, CLAMP = range(3)


@dataclass(frozen=True, eq=False)
class Bitmap:
    """Texels (H, W, 8), half: base colour RGB, metallic, dielectric specular RGB, roughness.

    Row 0 lies at v = 0. `wrap` says of u and v what lies beyond 0 … 1; with `nearest` texels are
    squares from close by, else they are blended. Equal `key`s mean equal bitmaps.
    """

    texels: NDArray[np.float16] = field(repr=False)
    wrap: tuple[int, int] = (REPEAT, REPEAT)
    nearest: bool = False
    key: str = ""


@dataclass(frozen=True)
class Picture:
    """An image file: its `name` for messages, its bytes."""

    name: str
    data: bytes = field(repr=False)

    @classmethod
    def of(cls, image: Any) -> Picture:
        """A picture that is decoded already."""
        data = io.BytesIO()
        image.save(data, "PNG")
        return cls("texture", data.getvalue())

    def image(self) -> Any:
        """The decoded picture, RGBA of 8 bits, of `MAX_SIDE` at most.

        Raises:
            OSError: it is damaged, or of an unknown format (Pillow says which).
        """
        return _decoded(self)


@dataclass(frozen=True)
class Surface:
    """What a file says of a surface: factors in [0, 1] times pictures, if there are some.

    Base colour and specular are linear; their pictures are sRGB. The green of `metal_rough` is
    roughness, its blue metallic (glTF); the alpha of `specular_picture` is 1 - roughness.
    With `conserving` the base colour is what specular leaves (KHR_materials_pbrSpecularGlossiness).
    Where alpha is below `cutoff` there is no surface; None is opaque everywhere.
    """

    base: tuple[float, float, float] = WHITE
    base_picture: Picture | None = None
    metallic: float = 0.0
    roughness: float = 1.0
    metal_rough: Picture | None = None
    specular: tuple[float, float, float] = (DIELECTRIC,) * 3
    specular_picture: Picture | None = None
    conserving: bool = False
    alpha: float = 1.0
    cutoff: float | None = None
    wrap: tuple[int, int] = (REPEAT, REPEAT)
    nearest: bool = False

    @property
    def plain(self) -> bool:
        """Whether one material says it all."""
        return not (self.base_picture or self.metal_rough or self.specular_picture)

    @functools.cached_property
    def material(self) -> Material:
        """The Phong terms of the factors alone."""
        row = self._texels()[0, 0]
        base, metallic, specular = row[:3], row[3], row[4:7]
        return Material(
            tuple((base * (1 - metallic)).tolist()),
            tuple((specular * (1 - metallic) + base * metallic).tolist()),
            exponent(float(row[7])),
        )

    @functools.cached_property
    def bitmap(self) -> Bitmap:
        """The texels; the same object for equal surfaces, of whichever files, while one is used.

        Raises:
            OSError: a picture can't be decoded.
        """
        bare = replace(self, base_picture=None, metal_rough=None, specular_picture=None)
        pictures = [b"" if p is None else hashlib.sha256(p.data).digest() for p in self._pictures()]
        key = hashlib.sha256(b"|".join([repr(bare).encode(), *pictures])).hexdigest()
        found = _BITMAPS.get(key)
        if found is None:
            images = [None if p is None else p.image() for p in self._pictures()]
            texels = self._texels(*images).astype(np.float16)
            found = _BITMAPS[key] = Bitmap(texels, self.wrap, self.nearest, key)
        return found

    def opacity(self) -> Floats | None:
        """Alpha (H, W) where `cutoff` asks for it, (1, 1) without a picture; None is opaque."""
        if self.cutoff is None:
            return None
        if self.base_picture is None:
            return np.full((1, 1), self.alpha)
        return np.asarray(self.base_picture.image().getchannel("A"), np.float64) / 255 * self.alpha

    def _pictures(self) -> tuple[Picture | None, Picture | None, Picture | None]:
        return self.base_picture, self.metal_rough, self.specular_picture

    def _texels(self, base: Any = None, rough: Any = None, shine: Any = None) -> Floats:
        """(H, W, 8) from the pictures' images, all at the largest one's size."""
        images = [image for image in (base, rough, shine) if image is not None]
        size = max((image.size for image in images), default=(1, 1))
        kind = np.float32 if images else np.float64  # constants are exact
        texels = np.empty((size[1], size[0], 8), kind)
        texels[..., :3] = self.base
        texels[..., 3], texels[..., 7] = self.metallic, self.roughness
        texels[..., 4:7] = self.specular
        if base is not None:
            found = _bytes(base, size)
            colour = LINEAR[found[..., :3]]
            there = found[..., 3] * (self.alpha / 255) >= (self.cutoff or 0)
            if there.any() and not there.all():
                # what is cut away shall not bleed into what is blended with it
                colour[~there] = colour[there].mean(0)
            texels[..., :3] *= colour
        if rough is not None:
            found = _bytes(rough, size)
            texels[..., 7] *= found[..., 1] / np.float32(255)
            texels[..., 3] *= found[..., 2] / np.float32(255)
        if shine is not None:
            found = _bytes(shine, size)
            texels[..., 4:7] *= LINEAR[found[..., :3]]
            texels[..., 7] = 1 - (1 - texels[..., 7]) * (found[..., 3] / np.float32(255))
        if self.conserving:
            texels[..., :3] *= 1 - texels[..., 4:7].max(-1, keepdims=True)
        return texels


@functools.lru_cache(maxsize=8)
def _decoded(picture: Picture) -> Any:
    from PIL import Image

    with Image.open(io.BytesIO(picture.data)) as found:
        if found.mode.startswith("I"):  # 16-bit greys, which `convert` would clip
            grey = np.asarray(found, np.float64) / 257
            image = Image.fromarray(grey.astype(np.uint8)).convert("RGBA")
        else:
            image = found.convert("RGBA")
    scale = MAX_SIDE / max(image.size)
    if scale >= 1:
        return image
    width, height = (max(1, round(side * scale)) for side in image.size)
    return image.resize((width, height), Image.Resampling.BOX)


_BITMAPS: WeakValueDictionary[str, Bitmap] = WeakValueDictionary()


def to_linear(srgb: Floats) -> Floats:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def exponent(roughness: float) -> float:
    """The Phong exponent of a glTF roughness: 2/α² - 2 with α = roughness², 1 to 2220.

    Walter et al., "Microfacet Models for Refraction through Rough Surfaces", 2007 (eq. 33's match).
    """
    return max(2 / max(roughness**2, 0.03) ** 2 - 2, 1.0)


def roughness_of(gloss: float) -> float:
    """The roughness whose `exponent` is `gloss`."""
    return float((2 / (max(gloss, 1.0) + 2)) ** 0.25)


# What a mesh is made of whose file gives colours alone.
BARE = Surface(roughness=roughness_of(Material().gloss))


def levels(texels: NDArray[np.float16]) -> list[NDArray[np.float16]]:
    """The texels and their means at half the size, and so on down to one; the finest first."""
    found = [texels]
    while max(found[-1].shape[:2]) > 1:
        fine = found[-1].astype(np.float32)
        for axis in (0, 1):
            fine = _halved(fine, axis)
        found.append(fine.astype(np.float16))
    return found


def _halved(values: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Means of neighbours along `axis`; of an odd count by shares, so that all count."""
    count = values.shape[axis]
    if count == 1:
        return values
    half = count // 2
    edges = np.linspace(0, count, half + 1)
    # Sums up to any place between two texels: the mean between two of those is a box's.
    sums = np.concatenate([np.zeros_like(values.take([0], axis)), values.cumsum(axis)], axis)
    low = np.minimum(edges.astype(int), count - 1)
    shape = [1] * values.ndim
    shape[axis] = -1
    part = (edges - low).reshape(shape).astype(np.float32)
    at = sums.take(low, axis) * (1 - part) + sums.take(low + 1, axis) * part
    return np.asarray(np.diff(at, axis=axis) * np.float32(half / count))


def _bytes(image: Any, size: Sequence[int]) -> NDArray[np.uint8]:
    """(H, W, 4) values of an image, resampled if its size is another."""
    return np.asarray(image if image.size == tuple(size) else image.resize(size))


# Of 8-bit sRGB values.
LINEAR = to_linear(np.arange(256) / 255).astype(np.float32)
