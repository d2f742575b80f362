"""How far the surroundings rise above each cell, in eight directions: what occludes it.

The sine of the horizon's elevation above the tangent plane, faded with distance, is what
horizon-based ambient occlusion integrates: L. Bavoil, M. Sainz and R. Dimitrov, *Image-Space
Horizon-Based Ambient Occlusion* (SIGGRAPH 2008 talks), equations 1 and 2. Here a network does the
integral, and only needs to be told the horizons, at a few distances and far fewer pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

# (rows down, columns right): along the axes, and along the diagonals.
_TURNS = (
    ((0, 1), (1, 0), (0, -1), (-1, 0)),
    ((1, 1), (1, -1), (-1, -1), (-1, 1)),
)
DIRECTIONS = 8
# Points count in full up to about half a radius, and not at all from _GONE radii on: as the sweep
# of our own horizon-based rivals found best.
_GONE, _FADE = 1.6, 0.9


def horizons(cells: Tensor, rings: Sequence[int], together: int = 1) -> Tensor:
    """The highest of the points that lie `rings` cells away, for each cell and direction.

    The first ring is looked at along the axes, the second along the diagonals, and so by turns.
    `cells` (N, 7, h, w) are unit normals, positions in effect radii, and 1 where there is geometry.
    Returns (N, 8, h, w) in [0, 1]: the sine of the angle at which a point rises above the cell's
    tangent plane, faded out towards 1.6 radii; 0 where nothing rises. `together` rings are
    calculated at a time, which changes nothing but speed: engines are quicker with few large
    tensors, up to what their caches hold.
    """
    normal, here, mask = cells[:, :3], cells[:, 3:7], cells[:, 6:]
    height, width = here.shape[2:]
    margin = max(rings)
    wide = F.pad(here, (margin, margin, margin, margin))
    highest: list[Tensor] = []
    for first in range(0, len(rings), together):
        corners = [
            (margin + ring * down, margin + ring * right)
            for index, ring in enumerate(rings[first : first + together], first)
            for down, right in _TURNS[index % 2]
        ]
        there = torch.stack([wide[:, :, y : y + height, x : x + width] for y, x in corners], 2)
        x, y, z = (there[:, k] + here[:, k : k + 1] * -1 for k in range(3))
        square = (x * x + y * y + z * z).clamp(1e-6, 4)  # beyond, all has faded anyway
        inverse = torch.rsqrt(square)
        near = ((square * inverse) * -_FADE + _GONE * _FADE).clamp(0, 1) * there[:, 3] * mask
        rise = x * normal[:, :1] + y * normal[:, 1:2] + z * normal[:, 2:]
        rise = F.relu(rise * inverse * near)
        for index, ring in enumerate(torch.split(rise, 4, 1), first):
            if index < 2:
                highest.append(ring)
            else:
                highest[index % 2] = torch.maximum(highest[index % 2], ring)
    return torch.cat(highest, 1)


def unit(vectors: Tensor) -> Tensor:
    """(N, 3, h, w) scaled to length 1; zeros stay zeros."""
    return vectors * torch.rsqrt(vectors.square().sum(1, keepdim=True) + 1e-12)


def sampled(x: Tensor, size: int) -> Tensor:
    """(N, C, H/size, W/size): the middle pixel of each block of `size` x `size`."""
    return x[:, :, size // 2 :: size, size // 2 :: size]
