"""Pictures for people: linear images as 8-bit sRGB, side by side, as PNG (needs Pillow)."""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from deepshade.effects import Effect
from deepshade.files import replacing

Picture = NDArray[np.uint8]

GAP = 4  # pixels between pictures


def srgb(image: ArrayLike) -> Picture:
    """(H, W, 3) 8-bit sRGB (IEC 61966-2-1) of a linear (H, W), (1, H, W) or (3, H, W) image.

    Values are clamped to [0, 1]; NaN becomes 0.
    """
    linear = np.clip(np.nan_to_num(np.asarray(image, np.float32)), 0.0, 1.0)
    curved = 1.055 * linear ** (1 / 2.4) - 0.055
    return shading(np.where(linear <= 0.0031308, 12.92 * linear, curved))


def shading(image: ArrayLike) -> Picture:
    """(H, W, 3) of a shading term in [0, 1], as it is: half the light is half the value.

    Occlusion is a factor, not a radiance; viewers and papers show it without sRGB's curve.
    """
    planes = np.asarray(image, np.float32)
    planes = planes[None] if planes.ndim == 2 else planes
    pixels = np.rint(255 * np.clip(np.nan_to_num(planes), 0, 1)).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(pixels, (3, *pixels.shape[1:])).transpose(1, 2, 0))


def of_effect(image: ArrayLike, effect: Effect) -> Picture:
    """(H, W, 3) of an effect's answer: `srgb` for light, else `shading`."""
    return srgb(image) if effect.is_light else shading(image)


def normals(image: ArrayLike) -> Picture:
    """(H, W, 3) of camera-space normals (3, H, W) in the usual colours; background is black."""
    planes = np.asarray(image, np.float32)
    there = np.abs(planes).sum(0) > 0
    return shading(np.where(there, planes * 0.5 + 0.5, 0))


def difference(image: ArrayLike, reference: ArrayLike, *, gain: float = 2.0) -> Picture:
    """(H, W, 3): red where `image` is too bright, blue where it is too dark, white where equal."""
    error = np.asarray(image, np.float32) - np.asarray(reference, np.float32)
    error = error.reshape(-1, *error.shape[-2:]).mean(0) * gain
    high, low = np.clip(error, 0, 1), np.clip(-error, 0, 1)
    return shading(np.stack([1 - low, 1 - low - high, 1 - high]))


def beside(pictures: Sequence[Picture]) -> Picture:
    """One row of pictures of equal height."""
    return _joined(pictures, axis=1)


def below(rows: Sequence[Picture]) -> Picture:
    """One column of pictures of equal width."""
    return _joined(rows, axis=0)


def png(picture: Picture, texts: Mapping[str, str] | None = None) -> bytes:
    """The bytes of a PNG file; grey pictures have one channel. `texts` (ASCII) go in by keyword."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    for keyword, text in (texts or {}).items():
        info.add_text(keyword, text)
    grey = (picture == picture[..., :1]).all()
    buffer = io.BytesIO()
    Image.fromarray(picture[..., 0] if grey else picture).save(
        buffer, "PNG", compress_level=3, pnginfo=info
    )
    return buffer.getvalue()


def texts_of(content: bytes) -> dict[str, str]:
    """The texts of a PNG file (its tEXt chunks), as `png` writes them; needs no Pillow."""
    found, at = {}, 8
    while at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if kind == b"tEXt":
            keyword, _, text = content[at + 8 : at + 8 + length].partition(b"\0")
            found[keyword.decode("latin-1")] = text.decode("latin-1")
        at += 12 + length
    return found


def save(path: Path, picture: Picture) -> None:
    """Write a PNG file atomically, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(png(picture))


def _joined(pictures: Sequence[Picture], axis: int) -> Picture:
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    pieces = [piece for picture in pictures for piece in (gap, picture)][1:]
    return np.concatenate(pieces, axis=axis)
