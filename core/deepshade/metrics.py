"""Image error: SSIM and DSSIM as the paper defines them, PSNR, MAE, SMAPE and FLIP."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Plane = NDArray[np.float64]

WINDOW = 8
C1 = 1e-4
C2 = 1e-3
_STRIP = 16  # rows of windows at a time: what is being worked on stays in the CPU's cache


def ssim_map(image: ArrayLike, reference: ArrayLike, *, window: int = WINDOW) -> Plane:
    """SSIM of every window: (H - window + 1, W - window + 1), or (C, …) for (C, H, W) images.

    Uniform windows at stride 1, variances over the window's pixels (divided by their number).
    Along a side shorter than the window, the window is that side. In [-1, 1].
    """
    x, y = _pair(image, reference)
    rows = min(window, x.shape[1])
    height, width = x.shape[1] - rows + 1, x.shape[2] - min(window, x.shape[2]) + 1
    maps = np.empty((x.shape[0], height, width))
    for channel in range(x.shape[0]):
        middle = y[channel].mean()
        for top in range(0, height, _STRIP):
            strip = slice(top, min(top + _STRIP, height) + rows - 1)
            maps[channel, top : top + _STRIP] = _ssim_strip(
                x[channel, strip], y[channel, strip], middle, window
            )
    return maps[0] if np.ndim(image) == 2 else maps


def _ssim_strip(x: Plane, y: Plane, middle: float, window: int) -> Plane:
    """SSIM of every window of two (H, W) planes, by sums over boxes in float64.

    `middle`, the reference's mean, is subtracted first, so that no variance is the small
    difference of large numbers, however far from 0 the image lies.
    """
    u, v = x - middle, y - middle
    rows, columns = min(window, x.shape[0]), min(window, x.shape[1])
    mean_u, mean_v, square, product = (
        _box_sums(_box_sums(plane, rows, 0), columns, 1) / (rows * columns)
        for plane in (u, v, u * u + v * v, u * v)
    )
    covariance = product - mean_u * mean_v
    variances = square - mean_u * mean_u - mean_v * mean_v  # of both together
    mean_x, mean_y = mean_u + middle, mean_v + middle
    top = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    bottom = (mean_x * mean_x + mean_y * mean_y + C1) * (variances + C2)
    return np.asarray(top / bottom)


def _box_sums(plane: Plane, size: int, axis: int) -> Plane:
    """Sums of every `size` neighbours along an axis, by halves: it becomes size - 1 shorter."""
    if size == 1:
        return plane

    def part(plane: Plane, start: int) -> Plane:
        end = start + length
        return plane[start:end] if axis == 0 else plane[:, start:end]

    length = plane.shape[axis] - size + 1
    half = _box_sums(plane, size // 2, axis)
    sums = part(half, 0) + part(half, size // 2)
    return sums + part(plane, size - 1) if size % 2 else sums


def ssim(image: ArrayLike, reference: ArrayLike, *, window: int = WINDOW) -> float:
    """Mean structural similarity of two (H, W) or (C, H, W) images: 1 = equal, in [-1, 1].

    The paper's: uniform 8 x 8 windows at stride 1, C1 = 1e-4, C2 = 1e-3, for values in [0, 1]
    (clamp them first). Raises ValueError for different shapes or non-finite values.
    """
    return float(ssim_map(image, reference, window=window).mean())


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


def smape(image: ArrayLike, reference: ArrayLike, *, epsilon: float = 0.01) -> float:
    """Symmetric mean absolute percentage error of two (H, W) or (C, H, W) images: in [0, 1].

    The mean of |x - y| / (|x| + |y| + epsilon): relative, so that it needs no clipping and one
    bright pixel doesn't outweigh the rest. For light; multiply both by `exposure(reference)` first,
    so that epsilon, which keeps black against nearly black from counting, means the same
    everywhere. Vogels et al., "Denoising with Kernel Prediction and Asymmetric Loss Functions",
    2018, section 3. Raises ValueError for different shapes or non-finite values.
    """
    x, y = _pair(image, reference)
    return float((np.abs(x - y) / (np.abs(x) + np.abs(y) + epsilon)).mean())


def exposure(reference: ArrayLike) -> float:
    """The factor that makes the 99th percentile of a picture's values 1.

    (H, W) or (C, H, W) light, all channels together. Both pictures of a comparison are multiplied
    by the reference's, then clipped to [0, 1] for `ssim` and `flip`. Where 99 % are black the
    maximum counts instead, and of an all-black picture it is 1. Raises ValueError for non-finite
    values.
    """
    values, _ = _pair(reference, reference)
    for white in (float(np.percentile(values, 99)), float(values.max())):
        if white > 1e-30:  # else the factor itself may overflow
            return 1.0 / white
    return 1.0


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
