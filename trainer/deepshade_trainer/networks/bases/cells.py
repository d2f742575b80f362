"""What cells of several pixels carry, smoothed along surfaces and given to the pixels of each."""

from __future__ import annotations

from functools import reduce
from operator import add

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.horizons import covered

# Neighbours count less by this much times the squared sine of how far off the tangent plane they
# lie; all count a little.
_BENT, _LEAST = 4.0, 1e-3
# What a cell counts whose own point shows nothing: it holds what is around.
_FALLBACK = 1e-4


def smoothed(carried: Tensor, normal: Tensor, position: Tensor) -> Tensor:
    """What cells carry (N, C, h, w), the mean over 3 x 3 of one surface.

    `normal` and `position` (N, 3, h, w) are zero where a cell's point shows nothing: such a cell
    takes what those around it have.
    """
    valid = covered(position[:, 2:])
    wide = F.pad(torch.cat([carried * valid, position, valid], 1), (1, 1, 1, 1))
    total, weights = carried * 0, valid * 0
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            light, there, known = torch.split(
                _beside(wide, down, right), [carried.shape[1], 3, 1], 1
            )
            weight = _same(there + position * -1, normal) * ((2.0 - abs(down)) * (2.0 - abs(right)))
            total = total + light * weight
            weights = weights + known * weight
    return total / weights.clamp_min(1e-6)


def enlarged(carried: Tensor, surface: Tensor, pixels: Tensor, side: int) -> Tensor:
    """What cells carry (N, C, h, w) at each of their `side` x `side` pixels.

    It is blended from the four nearest cells, those of the pixel's surface: `surface` (N, 6, h, w)
    and `pixels` (N, 6, side h, side w) are normals and positions. (J. Kopf, M. Cohen, D. Lischinski
    and M. Uyttendaele, *Joint Bilateral Upsampling*, 2007.)
    """
    count, channels, height, width = carried.shape
    wide = F.pad(torch.cat([carried, surface], 1), (1, 1, 1, 1))
    inside = F.pixel_unshuffle(pixels, side).reshape(count, 6, side, side, height, width)
    half = side // 2
    rows = []
    for below, upper in enumerate(torch.split(inside, half, 2)):
        columns = []
        for beside, quarter in enumerate(torch.split(upper, half, 3)):
            normal, position = torch.split(quarter.flatten(2, 3), 3, 1)
            total, weights = torch.zeros(()), torch.zeros(())
            for down in (0, 2 * below - 1):
                for right in (0, 2 * beside - 1):
                    light, facing, there = torch.split(
                        _beside(wide, down, right).unsqueeze(2), [channels, 3, 3], 1
                    )
                    alike = (_dot(facing, normal) * 0.5 + 0.5).clamp_min(_LEAST)
                    alike = alike * (covered(there[:, 2:]) + _FALLBACK)
                    near = _nearness(side, (below, down), (beside, right)).to(light)
                    weight = _same(there + position * -1, normal) * alike * near
                    total = total + light * weight
                    weights = weights + weight
            columns.append((total / weights).reshape(count, channels, half, half, height, width))
        rows.append(torch.cat(columns, 3))
    return F.pixel_shuffle(torch.cat(rows, 2).flatten(1, 3), side)


def _beside(wide: Tensor, down: int, right: int) -> Tensor:
    """Each cell's neighbour there; `wide` has one cell more all around."""
    return F.pad(wide, (-1 - right, right - 1, -1 - down, down - 1))


def _nearness(side: int, row: tuple[int, int], column: tuple[int, int]) -> Tensor:
    """Bilinear weights (1, 1, pixels, 1, 1) of a cell for a quarter of the pixels of one.

    Of each axis: which half of the pixels, and whether the cell is theirs (0) or a neighbour.
    """
    half = side // 2
    away = ((torch.arange(side) + 0.5) / side - 0.5).abs()  # of a pixel, from its cell's centre
    rows, columns = (
        (away if offset else 1 - away)[which * half :][:half] for which, offset in (row, column)
    )
    return (rows[:, None] * columns).reshape(1, 1, -1, 1, 1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Of vectors (N, 3, …): (N, 1, …). Engines are quicker at three planes than at a sum."""
    pairs = zip(torch.split(a, 1, 1), torch.split(b, 1, 1), strict=True)
    return reduce(add, (x * y for x, y in pairs))


def _same(delta: Tensor, normal: Tensor) -> Tensor:
    """How far something lies on a tangent plane, by its place from there: 1 to _LEAST."""
    square, off = _dot(delta, delta).clamp_min(1e-12), _dot(delta, normal)
    return (off * off / square * -_BENT + 1).clamp_min(_LEAST)
