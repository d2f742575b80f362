"""Which pixels of a G-buffer show nothing, or nothing usable, and setting those to zero."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.floats import is_finite

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

FAR = 1e10  # depths from here on mean that nothing was hit
DEPTHS = ("depth", "distance")
_BLOCK = 2**16  # pixels looked at together, so that the steps between stay in the cache


@np.errstate(invalid="ignore")
def remove(arrays: Mapping[str, Array], suspects: Collection[str]) -> tuple[Mask, int]:
    """Sets to 0 what shows no geometry; (these pixels, number that held NaN or infinities).

    `arrays` are (C, H, W) by quantity; only those named in `suspects` hold NaN or infinities,
    and where they do all are set to 0 as well. Attributes that say something of the background
    (the sky's light) stay there, where they are finite. Every pass over a picture counts: each
    quantity of a block of rows is first asked, by its extremes, whether it shows any background,
    and not asked where all are background already.
    """
    background = np.zeros(next(iter(arrays.values())).shape[1:], np.bool_)
    count = 0
    stays = {name for name in arrays if in_background(name)}
    for rows in _blocks(background.shape):
        block = {name: array[:, rows] for name, array in arrays.items()}
        empty = background[rows]
        count += _mark(block, suspects, empty)
        _clear([array for name, array in block.items() if name not in stays], empty)
        for name in stays.intersection(suspects):
            _clear([block[name]], nonfinite(block[name]))
    return background, count


@np.errstate(invalid="ignore")
def same(
    arrays: Mapping[str, Array], suspects: Collection[str], users: Iterable[Collection[str]]
) -> bool:
    """Whether `remove` would find the same for all `users`, who each look at some quantities."""
    asked = {frozenset(_EMPTY.keys() & set(user)) for user in users}
    if len({frozenset(suspects) & set(user) for user in users}) > 1:
        return False
    for rows in _blocks(next(iter(arrays.values())).shape[1:]):
        first: Mask | None = None
        for names in asked:
            block = {name: arrays[name][:, rows] for name in names}
            empty = np.zeros(next(iter(arrays.values()))[0, rows].shape, np.bool_)
            _mark(block, names.intersection(suspects), empty)
            if first is not None and (empty != first).any():
                return False
            first = empty
    return True


def in_background(quantity: str) -> bool:
    """Whether it says something where there is no surface too."""
    return quantity in ATTRIBUTES and ATTRIBUTES[quantity].in_background


def nonfinite(array: Array) -> Mask:
    """(H, W): where any of the channels is NaN or infinite."""
    if is_finite(array):
        return np.zeros(array.shape[1:], np.bool_)
    return np.asarray(~np.isfinite(array).all(axis=0))


def clear(arrays: Iterable[Array], background: Mask) -> None:
    """Sets (C, H, W) arrays to 0 where `background` (H, W) is true."""
    arrays = list(arrays)
    for rows in _blocks(background.shape):
        _clear([array[:, rows] for array in arrays], background[rows])


def _clear(arrays: Iterable[Array], background: Mask) -> None:
    if not background.any():
        return
    # a mask of bits: several times faster than a masked copy, and NaN can't survive it
    keep = None if background.all() else background.astype(np.int32) - np.int32(1)
    for array in arrays:
        bits = array.view(np.int32)
        if keep is not None:
            np.bitwise_and(bits, keep, out=bits)
        elif bits.view(np.uint32).max():  # mostly all are 0 already
            bits[...] = 0


def _mark(block: Mapping[str, Array], suspects: Collection[str], empty: Mask) -> int:
    """Marks in `empty` where nothing is shown; the number that held NaN or infinities."""
    # those first of which one channel tells
    for name in sorted(_EMPTY.keys() & block.keys(), key=list(_EMPTY).index):
        _EMPTY[name](block[name], empty)
        if empty.all():
            break
    return _broken({name: block[name] for name in suspects}, empty) if suspects else 0


def _broken(arrays: Mapping[str, Array], empty: Mask) -> int:
    """Marks in `empty` where any of the arrays isn't finite; how many of them show geometry."""
    broken, infinite = np.zeros_like(empty), np.zeros_like(empty)
    for name, array in arrays.items():
        if name in DEPTHS:  # an infinite depth is how renderers say that nothing was hit
            infinite |= np.isposinf(array[0])
            broken |= np.isnan(array[0]) | np.isneginf(array[0])
        else:
            broken |= nonfinite(array)
    np.logical_or(empty, broken | infinite, out=empty)
    return int(np.count_nonzero(broken & ~infinite))


def _blocks(shape: tuple[int, ...]) -> list[slice]:
    """Runs of the rows of a picture (H, W)."""
    step = max(1, _BLOCK // max(1, shape[1]))
    return [slice(top, top + step) for top in range(0, shape[0], step)]


# Each marks the pixels, in some rows of a (C, H, W) quantity, where it shows no geometry.


def _depth(array: Array, empty: Mask) -> None:
    depth = array[0]
    if not (depth.min() > 0 and depth.max() < FAR):
        np.logical_or(empty, ~((depth > 0) & (depth < FAR)), out=empty)  # not for NaN


def _alpha(array: Array, empty: Mask) -> None:
    if not array.min() > 0:
        np.logical_or(empty, array[0] <= 0, out=empty)


def _position(array: Array, empty: Mask) -> None:
    z = array[2]
    low, high = z.min(), z.max()
    if low == 0 == high:
        empty[...] = True
    elif not (high < 0 and low > -FAR):
        np.logical_or(empty, z == 0, out=empty)
        if not (high < FAR and low > -FAR):
            np.logical_or(empty, ~(np.abs(z) < FAR), out=empty)


def _vector(array: Array, empty: Mask) -> None:
    zero = array[-1] == 0  # the last, which seldom is, first
    for plane in array[-2::-1]:
        if not zero.any():
            return
        zero &= plane == 0
    np.logical_or(empty, zero, out=empty)


_EMPTY: dict[str, Callable[[Array, Mask], None]] = {
    "depth": _depth,
    "distance": _depth,
    "alpha": _alpha,
    "position": _position,
    "normal": _vector,
    "normal_world": _vector,
    "normal_object": _vector,
    "position_world": _vector,
}
SURFACE = frozenset(_EMPTY) - {"alpha"}  # quantities that are 0 where there is no surface
