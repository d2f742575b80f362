"""Where a pixel's depth leaves the plane of its neighbours: edges, cracks and bars, to the pixel.

Over the picture, 1/z of a plane is linear whatever its slope, so second differences of 1/z are zero
on it. Times z they are steps in depth, in shares of the distance.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.horizons import covered, faded, sampled

# A step of 1/250 of the distance, two pixels of 50 degrees over 512, is told as 0.7.
_STEEP = 250.0
_NEAREST = 1e-4  # radii: see `covered`


def edges(z: Tensor, size: int, filters: Tensor) -> Tensor:
    """Second differences of 1/z along rows and columns, for each pixel of cells `size` wide.

    `z` (N, 1, H, W) is negative, in effect radii, and 0 for background; `filters` as
    `second_differences` makes them. Returns (N, 2 size², H/size, W/size) in (-1, 1): above 0 where
    neighbours are nearer than a plane would be, as in a corner or a crack; faded out where they
    are farther off than what occludes. Cells of whose first pixel nothing is seen have 0.
    """
    inverse = covered(z) / (z * -1).clamp_min(_NEAREST)
    differences = F.conv2d(inverse, filters, stride=size, padding=1)
    distance = sampled(z, size, 0) * -1
    step = differences * distance  # of the distance
    steep = step * _STEEP
    return steep * torch.rsqrt(steep * steep + 1) * faded((step * distance).abs())


def second_differences(size: int) -> Tensor:
    """The filters (2 size², 1, size + 2, size + 2): along the row, then the column, by pixel."""
    found = torch.zeros(size, size, 2, size + 2, size + 2)
    for row in range(size):
        for column in range(size):
            y, x = row + 1, column + 1
            found[row, column, :, y, x] = -2
            found[row, column, 0, y, [x - 1, x + 1]] = 1
            found[row, column, 1, [y - 1, y + 1], x] = 1
    return found.reshape(2 * size * size, 1, size + 2, size + 2)
