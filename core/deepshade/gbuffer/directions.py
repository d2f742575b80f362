"""Directions that have no length that a direction has: damaged, or of another encoding."""

from __future__ import annotations

from collections.abc import MutableMapping

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES, CAMERA_DIRECTION, WORLD_DIRECTION

# A unit vector interpolated or stored in few bits is never so long. Shorter ones stay as they are.
LONGEST = 1.25


@np.errstate(all="ignore")
def mend(arrays: MutableMapping[str, NDArray[np.float32]]) -> None:
    """Scales, in place, directions (3, H, W) longer than `LONGEST` to length 1; those whose square
    is 0 in float32 point nowhere and become 0.

    A network convolves them: a single pixel of 65504 would drown all that is within its reach.
    What isn't finite stays.
    """
    for name, array in arrays.items():
        attribute = ATTRIBUTES.get(name)
        if attribute is None or attribute.unit not in (CAMERA_DIRECTION, WORLD_DIRECTION):
            continue
        square = np.einsum("chw,chw->hw", array, array)
        if (none := square == 0).any():
            array[:, none] = 0
        if (long := square > LONGEST**2).any():
            vectors = array[:, long].astype(np.float64)
            vectors /= np.sqrt((vectors * vectors).sum(0))
            finite = np.isfinite(vectors).all(0)
            array[:, long] = np.where(finite, vectors, array[:, long])
