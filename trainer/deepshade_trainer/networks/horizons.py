"""How far the surroundings rise above each cell, in eight directions: what occludes it.

The sine of the horizon's elevation above the tangent plane, faded with distance, is what
horizon-based ambient occlusion integrates: L. Bavoil, M. Sainz and R. Dimitrov, *Image-Space
Horizon-Based Ambient Occlusion* (SIGGRAPH 2008 talks), equations 1 and 2. Here a network does the
integral, and only needs to be told the horizons, at a few distances and far fewer pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor
from torch.nn import functional as F

# (rows down, columns right): along the axes, and along the diagonals.
_TURNS = (
    ((0, 1), (1, 0), (0, -1), (-1, 0)),
    ((1, 1), (1, -1), (-1, -1), (-1, 1)),
)
# Points count in full up to about half a radius, and not at all from _GONE radii on: as the sweep
# of our own horizon-based baselines found best.
_GONE, _FADE = 1.6, 0.9
_AWAY = 1e4  # effect radii


def directions(rings: Sequence[int]) -> int:
    """In how many directions these rings are looked at: the axes, and with a second ring all 8."""
    return 4 * min(2, len(rings))


def horizons(cells: Tensor, rings: Sequence[int], together: bool = False) -> Tensor:
    """The highest of the points that lie `rings` cells away, for each cell and direction.

    The first ring is looked at along the axes, the second along the diagonals, and so by turns.
    `cells` (N, 7, h, w) are unit normals, positions in effect radii, and 1 where there is geometry.
    Returns (N, `directions`, h, w) in [0, 1]: the sine of the angle at which a point rises above
    the cell's tangent plane, faded out towards 1.6 radii; 0 where nothing rises. `together` changes
    nothing but speed: engines are quicker with one neighbour at a time where there are many cells,
    and with all of them at once where there are few.
    """
    normals, across, depth, coverage = torch.split(cells, [3, 2, 1, 1], 1)
    normal = torch.split(normals, 1, 1)
    # Nothing is near what is far behind the camera: neither background nor the picture's edge.
    here = torch.cat([across, depth + (coverage * -_AWAY + _AWAY)], 1)  # (N, 3, h, w)
    margin = max(rings)
    wide = F.pad(here, (margin, margin, margin, margin), value=_AWAY)
    neighbours = [
        _cut(wide, margin, ring * down, ring * right)
        for index, ring in enumerate(rings)
        for down, right in _TURNS[index % 2]
    ]
    found: list[Tensor] = []
    for there in [torch.stack(neighbours, 2)] if together else neighbours:
        x, y, z = (
            (theirs.squeeze(1) if together else theirs) + ours * -1
            for theirs, ours in zip(torch.split(there, 1, 1), torch.split(here, 1, 1), strict=True)
        )
        square = (x * x + y * y + z * z).clamp(1e-6, 4)  # beyond, all has faded anyway
        inverse = torch.rsqrt(square)
        near = faded(square * inverse)
        rise = x * normal[0] + y * normal[1] + z * normal[2]
        found.append(F.relu(rise * inverse * near))
    if together:
        found = list(torch.split(found[0], 4, 1))
    turn = directions(rings) // (4 if together else 1)
    return torch.cat([reduce(torch.maximum, found[k::turn]) for k in range(turn)], 1)


def faded(distance: Tensor) -> Tensor:
    """How much what is so many effect radii away counts, in [0, 1]."""
    return (distance * -_FADE + _GONE * _FADE).clamp(0, 1)


def _cut(wide: Tensor, margin: int, down: int, right: int) -> Tensor:
    """`wide` without its margin, moved: one operation, where slicing would be two."""
    return F.pad(wide, (-margin - right, right - margin, -margin - down, down - margin))


def unit(vectors: Tensor) -> Tensor:
    """(N, 3, h, w) scaled to length 1; zeros stay zeros."""
    x, y, z = torch.split(vectors, 1, 1)
    return vectors * torch.rsqrt(x * x + y * y + z * z + 1e-12)


def covered(z: Tensor) -> Tensor:
    """1 where there is geometry, of the same shape; nearer than 1e-4 radii nothing can be."""
    return (z * -1e4).clamp(0, 1)


def sampled(x: Tensor, size: int, pixel: int | None = None) -> Tensor:
    """(N, C, H/size, W/size): one pixel of each block of `size` x `size`.

    The one in this row and column of the block; by default the middle one.
    """
    pixel = size // 2 if pixel is None else pixel
    count, channels, height, width = x.shape
    # Engines are quicker to copy whole rows, and then pick from these, than to pick at once.
    rows = x.reshape(count, channels, height // size, size * width)
    rows = rows[..., pixel * width : (pixel + 1) * width]
    return rows.reshape(count, channels, height // size, width // size, size)[..., pixel]
