"""Fast passes over planes of floats: half to float32 and back, and whether all are finite.

numpy converts halves one at a time. Shifts, masks and one product over whole planes give the same
bits; the rare values for which they would not (NaN, infinities, what overflows) go to numpy.
Layout of both formats: IEEE 754-2019, table 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

HALF_MAX = 65504.0

_SMALLEST_NORMAL = 2.0**-14
_EXPONENT = np.int16(0x7C00)  # of NaN and infinities
_NEGATIVE_EXPONENT = np.uint16(0xFC00)
_SHIFT = np.int32(23 - 10)  # between the two mantissas
_SIGN_AND_VALUE = np.int32(-0x70002000)  # 0x8FFFE000, without the copies of the sign
_REBIAS = np.float32(2.0 ** (127 - 15))
_PIECE = 2**16  # numbers converted at a time, so that the steps between stay in the cache


def to_float(halves: NDArray[np.float16], out: NDArray[np.float32]) -> bool:
    """Writes C-contiguous `halves` to `out`, of their shape; whether all of them are finite."""
    bits = halves.view(np.int16)
    # as signed numbers the positive NaN and infinities are the largest, as unsigned the negative
    if bits.max() >= _EXPONENT or halves.view(np.uint16).max() >= _NEGATIVE_EXPONENT:
        np.copyto(out, halves)
        return False
    target = out.view(np.int32)
    np.copyto(target, bits)  # extends the sign
    np.left_shift(target, _SHIFT, out=target)
    np.bitwise_and(target, _SIGN_AND_VALUE, out=target)
    np.multiply(out, _REBIAS, out=out)  # also makes a half's subnormals normal
    return True


def adjacent(planes: Sequence[NDArray[np.float32]]) -> NDArray[np.float32] | None:
    """(C, H, W) of planes (H, W) that lie one after the other in one array, uncopied; else None."""
    block, shape, size = planes[0].base, planes[0].shape, planes[0].nbytes
    if not (isinstance(block, np.ndarray) and block.flags.c_contiguous and size):
        return None
    if not all(plane.base is block and plane.flags.c_contiguous for plane in planes):
        return None
    at = [plane.ctypes.data - block.ctypes.data for plane in planes]
    if np.any(np.diff(at) != size) or at[0] % size or block.nbytes % size:
        return None
    return block.reshape(-1, *shape)[at[0] // size : at[0] // size + len(planes)]


def is_finite(values: NDArray[np.float32]) -> bool:
    """Whether none of the numbers is NaN or infinite; empty arrays are."""
    if not values.size:
        return True
    return bool(
        values.view(np.int32).max() < 0x7F800000 and values.view(np.uint32).max() < 0xFF800000
    )


@np.errstate(invalid="ignore", over="ignore")
def to_half(values: NDArray[Any]) -> NDArray[np.float16]:
    """`values` in 16 bits, rounded to nearest even; C-contiguous.

    Finite values beyond ±65504 are clamped there; infinities and NaN stay.
    """
    values = np.ascontiguousarray(values, np.float32)
    halves = np.empty(values.shape, np.float16)
    flat, out = values.reshape(-1), halves.reshape(-1)
    for at in range(0, flat.size, _PIECE):
        _piece_to_half(flat[at : at + _PIECE], out[at : at + _PIECE])
    return halves


def _piece_to_half(values: NDArray[np.float32], out: NDArray[np.float16]) -> None:
    low, high = values.min(), values.max()  # NaN if one is: no comparison holds then
    if low >= _SMALLEST_NORMAL and high <= HALF_MAX:
        bits = values.view(np.uint32)
        odd = bits >> np.uint32(_SHIFT)
        odd &= np.uint32(1)
        odd += bits
        # just less than half a step, which the odd ones make a full half: ties go to even
        odd += np.uint32(2**32 + 0xFFF - ((127 - 15) << 23))
        odd >>= np.uint32(_SHIFT)
        np.copyto(out.view(np.uint16), odd, casting="unsafe")
        return
    if not (low >= -HALF_MAX and high <= HALF_MAX):
        limited = np.clip(values, -HALF_MAX, HALF_MAX)
        np.copyto(limited, values, where=np.isinf(values))
        values = limited
    np.copyto(out, values, casting="same_kind")
