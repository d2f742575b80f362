"""Directions that are longer than any direction: damaged, or of another encoding."""

from __future__ import annotations

from collections.abc import MutableMapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES, CAMERA_DIRECTION, WORLD_DIRECTION

# A unit vector interpolated or stored in few bits is never so long. Shorter ones stay as they are.
LONGEST = 1.25


def shorten(arrays: MutableMapping[str, NDArray[np.float32]]) -> None:
    """Scales, in place, finite directions (3, H, W) longer than `LONGEST` to length 1, where any
    has so large a component.

    A network convolves them: a single pixel of 65504 would drown all that is within its reach.
    """
    for name, array in arrays.items():
        attribute = ATTRIBUTES.get(name)
        if attribute is None or attribute.unit not in (CAMERA_DIRECTION, WORLD_DIRECTION):
            continue
        if array.size == 0 or max(array.max(), -array.min()) <= LONGEST:
            continue
        square: NDArray[Any] = np.einsum("chw,chw->hw", array, array, dtype=np.float64)
        long = square > LONGEST**2
        if long.any():
            array[:, long] /= np.sqrt(square[long])
