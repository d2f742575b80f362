"""The 8 quarter turns and mirrors of an image, with camera-space vectors turned along.

Screen-space shading has no preferred direction, so each rendered view gives eight to learn from.
They cost less to make than to read, so the trainer applies them to each batch; the workers store
them only where another trainer is to read plain shards (`datagen --augment`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES

ALL = tuple(range(8))
# Those that mirror nothing: the quarter turns.
ROTATIONS = (0, 3, 5, 6)


def apply(image: NDArray[Any], attribute: str | None, symmetry: int) -> NDArray[Any]:
    """Apply `symmetry` (0 to 7) to planar images (..., C, H, W).

    `symmetry` & 1 mirrors left and right, & 2 up and down, & 4 swaps rows and columns, in this
    order. The x and y (u and v) of an `attribute` whose unit turns change alike; None, and
    attributes without a direction, only move their pixels.

    Raises:
        ValueError: `symmetry` is out of range.
    """
    if symmetry not in ALL:
        raise ValueError(f"there is no symmetry {symmetry}, only 0 to {len(ALL) - 1}")
    turns = ATTRIBUTES[attribute].unit.turns if attribute in ATTRIBUTES else None
    # A symmetry maps screen axes to screen axes: find which, and with what sign.
    x, y = (0, 1.0), (1, 1.0)
    if symmetry & 1:
        image, x = image[..., ::-1], (x[0], -x[1])
    if symmetry & 2:
        image, y = image[..., ::-1, :], (y[0], -y[1])
    if symmetry & 4:
        image = image.swapaxes(-1, -2)
        # Rows run down and y up, so the swap sends +x to -y; the screen's v runs down like rows.
        sign = 1.0 if turns == "screen" else -1.0
        x, y = (y[0], sign * y[1]), (x[0], sign * x[1])
    if turns is None:
        return image
    planes = [image[..., x[0], :, :] * x[1], image[..., y[0], :, :] * y[1]]
    planes += [image[..., k, :, :] for k in range(2, image.shape[-3])]
    return np.stack(planes, -3)
