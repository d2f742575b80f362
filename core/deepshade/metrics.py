"""Image error: SSIM and DSSIM as the paper defines them, PSNR, MAE, and FLIP."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Plane = NDArray[np.float64]

WINDOW = 8
C1 = 1e-4
C2 = 1e-3
_STRIP = 16  # rows of windows at a time: what is being worked on stays in the CPU's cache


@dataclass(slots=True)
class _Moments:
    """Means, and sums of squared or multiplied deviations from them, over n pixels each."""

    n: int
    x: Plane
    y: Plane
    xx: Plane
    yy: Plane
    xy: Plane

    def cut(self, axis: int, start: int, length: int) -> _Moments:
        index = (
            (slice(None), slice(start, start + length)) if axis else slice(start, start + length)
        )
        return _Moments(
            self.n,
            *(p[index] for p in (self.x, self.y, self.xx, self.yy, self.xy)),
        )

    def joined(self, other: _Moments) -> _Moments:
        """Both sets of pixels as one (Chan, Golub, LeVeque 1979): no large sums to cancel."""
        n = self.n + other.n
        dx, dy = other.x - self.x, other.y - self.y
        share = other.n / n
        weight = self.n * share
        return _Moments(
            n,
            self.x + dx * share,
            self.y + dy * share,
            self.xx + other.xx + dx * dx * weight,
            self.yy + other.yy + dy * dy * weight,
            self.xy + other.xy + dx * dy * weight,
        )

    def windows(self, size: int, axis: int) -> _Moments:
        """Every run of `size` pixels along an axis, built from runs of 1, 2, 4, … pixels."""
        length = self.x.shape[axis] - size + 1
        block, width = self, 1  # block: all runs of `width` pixels
        result: _Moments | None = None
        covered = 0
        while True:
            if size & width:
                piece = block.cut(axis, covered, length)
                result = piece if result is None else result.joined(piece)
                covered += width
            if covered == size:
                assert result is not None
                return result
            room = block.x.shape[axis] - width
            block = block.cut(axis, 0, room).joined(block.cut(axis, width, room))
            width *= 2


def ssim_map(
    image: ArrayLike,
    reference: ArrayLike,
    *,
    window: int = WINDOW,
    c1: float = C1,
    c2: float = C2,
) -> Plane:
    """SSIM of every window: (H - window + 1, W - window + 1), or (C, …) for (C, H, W) images.

    Uniform windows at stride 1, variances over the window's pixels (divided by their number).
    Along a side shorter than the window, the window is that side. In [-1, 1].
    """
    x, y = _pair(image, reference)
    rows = min(window, x.shape[1])
    height, width = x.shape[1] - rows + 1, x.shape[2] - min(window, x.shape[2]) + 1
    maps = np.empty((x.shape[0], height, width))
    for channel in range(x.shape[0]):
        for top in range(0, height, _STRIP):
            strip = slice(top, min(top + _STRIP, height) + rows - 1)
            maps[channel, top : top + _STRIP] = _ssim_strip(
                x[channel, strip], y[channel, strip], window, c1, c2
            )
    return maps[0] if np.ndim(image) == 2 else maps


def _ssim_strip(x: Plane, y: Plane, window: int, c1: float, c2: float) -> Plane:
    zero = np.zeros_like(x)
    m = _Moments(1, x, y, zero, zero, zero)
    for axis in (0, 1):
        m = m.windows(min(window, x.shape[axis]), axis)
    top = (2 * m.x * m.y + c1) * (2 / m.n * m.xy + c2)
    bottom = (m.x * m.x + m.y * m.y + c1) * ((m.xx + m.yy) / m.n + c2)
    return np.asarray(top / bottom)


def ssim(
    image: ArrayLike,
    reference: ArrayLike,
    *,
    window: int = WINDOW,
    c1: float = C1,
    c2: float = C2,
) -> float:
    """Mean structural similarity of two (H, W) or (C, H, W) images: 1 = equal, in [-1, 1].

    The paper's: uniform 8 x 8 windows at stride 1, C1 = 1e-4, C2 = 1e-3, for values in [0, 1]
    (clamp them first). Raises ValueError for different shapes or non-finite values.
    """
    return float(ssim_map(image, reference, window=window, c1=c1, c2=c2).mean())


def dssim(image: ArrayLike, reference: ArrayLike) -> float:
    """(1 - SSIM) / 2, the paper's loss: 0 = equal, in [0, 1]."""
    return (1.0 - ssim(image, reference)) / 2.0


def mae(image: ArrayLike, reference: ArrayLike) -> float:
    """Mean absolute difference of two (H, W) or (C, H, W) images."""
    x, y = _pair(image, reference)
    return float(np.abs(x - y).mean())


def psnr(image: ArrayLike, reference: ArrayLike, *, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in decibels; infinite for equal images."""
    x, y = _pair(image, reference)
    error = float(np.square(x - y).mean())
    return math.inf if error == 0 else 10.0 * math.log10(peak * peak / error)


def flip(image: ArrayLike, reference: ArrayLike, *, pixels_per_degree: float = 67.0) -> float:
    """Mean LDR-FLIP error of two linear images in [0, 1]: 0 = equal, in [0, 1].

    (H, W) and (1, H, W) count as grey, (3, H, W) as RGB. Andersson et al., "FLIP: A Difference
    Evaluator for Alternating Images", 2020, through the package flip-evaluator (extra `trainer`).
    """
    import flip_evaluator

    x, y = (np.clip(v, 0.0, 1.0) for v in _pair(image, reference))
    if x.shape[0] not in (1, 3):
        raise ValueError(f"FLIP needs 1 or 3 channels, not {x.shape[0]}")
    pictures = [
        np.ascontiguousarray(np.broadcast_to(v, (3, *v.shape[1:])).transpose(1, 2, 0), np.float32)
        for v in (y, x)
    ]
    result: Any = flip_evaluator.evaluate(
        *pictures,
        "LDR",
        inputsRGB=False,
        applyMagma=False,
        computeMeanError=True,
        parameters={"ppd": pixels_per_degree},
    )
    return float(result[1])


def _pair(image: ArrayLike, reference: ArrayLike) -> tuple[Plane, Plane]:
    x, y = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    if x.shape != y.shape:
        raise ValueError(f"the images differ in shape: {x.shape} and {y.shape}")
    if x.ndim not in (2, 3) or x.size == 0:
        raise ValueError(f"an image is (H, W) or (C, H, W), not {x.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("the images hold non-finite values")
    return (x[None], y[None]) if x.ndim == 2 else (x, y)
