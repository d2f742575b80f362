"""Real views as frames of any size, with any share of background, and as EXR bodies."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade_report.method import View

T = TypeVar("T", bound=np.generic)

WIDTH, HEIGHT = 768, 512  # the paper's frame
MEGAPIXELS = WIDTH * HEIGHT / 1e6


def fullest(views: Sequence[View]) -> View:
    """The view with the least background: what can be skipped shall not flatter a timing."""
    return min(views, key=lambda view: float(view.background.mean()))


def extended(view: View, height: int, width: int) -> View:
    """The view cut, or continued by mirroring, to `height` x `width`.

    Mirrored positions are no real geometry, but smooth, and in the values that a timing needs.
    """
    return replace(
        view,
        normal=_fit(view.normal, height, width),
        position=_fit(view.position, height, width),
        background=_fit(view.background, height, width),
        reference=_fit(view.reference, height, width),
    )


def large_body(view: View, height: int, width: int) -> bytes:
    """The body of a view that was cut or continued to any size, with grain.

    What repeats compresses far better than any real picture. So the two lowest bits of each half
    float are random, which is less than a thousandth of its value. Planes are made one by one,
    which spares memory at 8192 x 8192.
    """
    grain = np.random.default_rng(0).integers(0, 4, 2**20 + 7, dtype=np.uint16)
    channels: dict[str, NDArray[np.float16]] = {}
    for name, planes in (("normal", view.normal), ("position", view.position)):
        for axis, plane in zip("XYZ", planes, strict=True):
            half = _fit(plane.astype(np.float16), height, width)
            bits = half.view(np.uint16)
            np.bitwise_xor(bits, np.resize(grain, bits.shape), out=bits, where=bits != 0)
            channels[f"{name}.{axis}"] = half
    # the angle that keeps the view's pixels per unit
    return _encoded(channels, replace(view, background=np.empty((height, width), bool)), "zip")


def emptied(view: View, share: float, shape: str = "sky") -> View:
    """The view with background in at least `share` (0 to 1) of its pixels.

    "sky" empties rows from the top; "object" empties everything around a centred ellipse.
    Raises ValueError for another shape.
    """
    height, width = view.background.shape
    y, x = (np.mgrid[0:height, 0:width] + 0.5) / np.array([height, width])[:, None, None]
    if shape == "sky":
        rank = y
    elif shape == "object":
        rank = -np.hypot(y - 0.5, x - 0.5)
    else:
        raise ValueError(f"no shape is called '{shape}'")
    count = round(share * height * width)
    empty = np.zeros(height * width, bool)
    empty[np.argsort(rank, axis=None, kind="stable")[:count]] = True
    background = view.background | empty.reshape(height, width)
    there = ~background
    return replace(
        view,
        normal=np.where(there, view.normal, np.float32(0)),
        position=np.where(there, view.position, np.float32(0)),
        background=background,
        reference=np.where(background, np.float32(1), view.reference),
    )


def body(view: View, *, extra: int = 0, compression: str = "zip") -> bytes:
    """The view as a renderer would send it: an EXR of half floats, with radius and fov.

    `extra` adds that many channels that ambient occlusion doesn't read (a colour pass and more,
    made from the normals, so that they compress like pixels do).
    """
    channels: dict[str, NDArray[np.float16]] = {}
    for name, planes in (("normal", view.normal), ("position", view.position)):
        for axis, plane in zip("XYZ", planes, strict=True):
            channels[f"{name}.{axis}"] = np.asarray(plane, np.float16)
    for number in range(extra):
        layer, part = divmod(number, 3)
        plane = view.normal[part] * np.float32(0.3 + 0.1 * layer) + np.float32(0.5)
        channels[f"pass{layer + 1}.{'RGB'[part]}"] = plane.astype(np.float16)
    return _encoded(channels, view, compression)


def _encoded(channels: dict[str, NDArray[np.float16]], view: View, compression: str) -> bytes:
    stream = io.BytesIO()
    exr.write(
        stream,
        channels,
        half=True,
        compression=compression,
        attributes={"deepshade:fov": _angle(view), "deepshade:radius": float(view.radius)},
    )
    return stream.getvalue()


def _angle(view: View) -> float:
    """Degrees that the frame spans from left to right, at the view's pixels per unit."""
    return math.degrees(2 * math.atan(view.width / 2 / view.pixel_scale()))


def _fit(image: NDArray[T], height: int, width: int) -> NDArray[T]:
    rows, columns = image.shape[-2:]
    pad = [(0, 0)] * (image.ndim - 2)
    pad += [(0, max(0, height - rows)), (0, max(0, width - columns))]
    return np.ascontiguousarray(np.pad(image, pad, "symmetric")[..., :height, :width])
