"""Which pixels of a G-buffer show nothing, or nothing usable, and setting those to zero."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from deepshade.floats import is_finite

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

FAR = 1e10  # depths from here on mean that nothing was hit
DEPTHS = ("depth", "distance")


@np.errstate(invalid="ignore")
def find(arrays: Mapping[str, Array], suspects: Collection[str]) -> tuple[Mask, int]:
    """(pixels without geometry, number of pixels that hold NaN or infinities).

    `arrays` are (C, H, W) by quantity; only those named in `suspects` hold NaN or infinities.
    Mostly there is little background to find: each quantity is first asked, by its extremes,
    whether it shows any, because every pass over a picture counts.
    """
    shape = next(iter(arrays.values())).shape[1:]
    background = np.zeros(shape, np.bool_)
    broken, infinite = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for name, array in arrays.items():
        suspect = name in suspects
        if name in DEPTHS:
            depth = array[0]
            if suspect or not (depth.min() > 0 and depth.max() < FAR):
                background |= ~((depth > 0) & (depth < FAR))  # not for NaN
            if suspect:  # an infinite depth is how renderers say that nothing was hit
                infinite |= np.isposinf(depth)
                broken |= np.isnan(depth) | np.isneginf(depth)
            continue
        if suspect:
            broken |= nonfinite(array)
        if name == "alpha":
            if suspect or not array.min() > 0:
                background |= array[0] <= 0
        elif name == "position":
            z = array[2]
            if suspect or not (z.max() < 0 and z.min() > -FAR):
                background |= ~((z != 0) & (np.abs(z) < FAR))
        elif name in ("normal", "normal_world", "position_world"):
            background |= _zero(array)
    if not suspects:
        return background, 0
    broken &= ~infinite
    return background | broken | infinite, int(np.count_nonzero(broken))


def nonfinite(array: Array) -> Mask:
    """(H, W): where any of the channels is NaN or infinite."""
    if is_finite(array):
        return np.zeros(array.shape[1:], np.bool_)
    return np.asarray(~np.isfinite(array).all(axis=0))


def clear(arrays: Iterable[Array], background: Mask) -> None:
    """Sets (C, H, W) arrays to 0 where `background` (H, W) is true."""
    if not background.any():
        return
    # a mask of bits: several times faster than a masked copy, and NaN can't survive it
    keep = background.astype(np.int32)
    keep -= 1
    for array in arrays:
        bits = array.view(np.int32)
        np.bitwise_and(bits, keep, out=bits)


def _zero(array: Array) -> Mask:
    """(H, W): where all channels are 0. The last, which seldom is, first."""
    zero = np.asarray(array[-1] == 0)
    for plane in array[-2::-1]:
        if not zero.any():
            break
        zero &= plane == 0
    return zero
