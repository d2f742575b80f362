"""How much of each direction the surroundings of each cell block, slice by slice.

A slice is the half plane from the ray to the eye to one side of it; what it sees is a row of
samples on the screen. It is cut into sectors of equal solid angle. A sample blocks those between
its front and its back, which lies a thickness farther along the eye's ray: O. Therrien, Y. Levesque
and G. Gilet, *Screen Space Indirect Lighting with Visibility Bitmask*, The Visual Computer 2023.
Here sectors are blocked in part, as far as the sample that blocks most of each does.

A cell's own frame has z towards the eye, and is turned out of the camera's by the least angle. So
the directions of sectors in camera space depend on where the cell stands in the picture; what light
comes from there is a polynomial of that place, which `nodes` finds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.horizons import covered

Float64 = NDArray[np.float64]

CELL = 4  # pixels along a side
TAKEN = 2  # the pixel of a cell that stands for it, each way
AZIMUTHS, HEIGHTS = 12, 6  # slices around, and sectors of each
SECTORS = AZIMUTHS * HEIGHTS
_DEGREE = 3  # of the polynomials
TERMS = (_DEGREE + 1) * (_DEGREE + 2) // 2
_SIDE = 0.6  # sine of the angle to the camera's axis up to which they hold
_AWAY = 1e4  # effect radii
_TINY = 1e-12
_THICK = 0.455  # effect radii, as tuned for the bitmask
# pixels to a sample
_STEPS = (2, 4, 5, 6, 8, 10, 13, 17, 21, 27, 35, 44, 56, 71, 90, 114, 145)
REACH = 1 + (TAKEN + _STEPS[-1]) // CELL  # cells


def toward_eye(position: Tensor) -> Tensor:
    """(N, 3, h, w) positions to the unit vector to the eye; 0 where they are 0."""
    return position * -torch.rsqrt((position * position).sum(1, keepdim=True) + _TINY)


def into_frame(eye: Tensor, vectors: Tensor) -> Tensor:
    """Camera space to the cells' own frames, (N, 3, h, w) both."""
    ex, ey, ez = torch.split(eye, 1, 1)
    x, y, z = torch.split(vectors, 1, 1)
    aside = ex * x + ey * y
    move = z + aside / (ez.clamp_min(0) + 1)
    return torch.cat([x - ex * move, y - ey * move, aside + ez * z], 1)


def out_of_frame(eye: Tensor, vectors: Tensor) -> Tensor:
    """The cells' own frames to camera space: `eye` (N, 3, 1, h, w), `vectors` (N, 3, K, h, w)."""
    ex, ey, ez = torch.split(eye, 1, 1)
    x, y, z = torch.split(vectors, 1, 1)
    aside = ex * x + ey * y
    move = z - aside / (ez.clamp_min(0) + 1)
    return torch.cat([x + ex * move, y + ey * move, ez * z - aside], 1)


def slices(folded: Tensor, at: Tensor) -> list[Tensor]:
    """How much of the sectors of each slice each cell sees blocked: AZIMUTHS of (N, HEIGHTS, h, w).

    `folded` (N, 6, 16, h, w) are normals and positions, in effect radii, of the pixels of each
    cell; `at` (N, 7, h, w) those of the one taken, its normal of length 1, and 1 where there is
    geometry. Sectors come from the eye's ray on; below the surface's horizon they are 0.
    """
    # nothing is near what is far behind the camera: neither background nor the picture's edge
    across, depth = torch.split(folded[:, 3:], [2, 1], 1)
    places = torch.cat([across, depth + (covered(depth) * -_AWAY + _AWAY)], 1)
    wide = F.pad(places, (REACH, REACH, REACH, REACH, 0, 0), value=_AWAY)
    pixels = [part.squeeze(2) for part in torch.split(wide, 1, 2)]
    here = at[:, 3:6]
    eye = toward_eye(here)
    right, up, facing = torch.split(into_frame(eye, at[:, :3]), 1, 1)
    ex, ey, ez = torch.split(eye, 1, 1)
    edges = np.linspace(1, -1, HEIGHTS + 1).tolist()
    found = []
    for azimuth in range(AZIMUTHS):
        cos, sin = _turn(azimuth)
        there = torch.stack([_moved(pixels, step, azimuth) for step in _STEPS], 2)
        x, y, z = (part.flatten(1, 2) for part in torch.split(there - here[:, :, None], 1, 1))
        rise = x * ex + y * ey + z * ez
        aside = (x * x + y * y + z * z - rise * rise).clamp(1e-8, 4)
        # what is farther than a radius blocks nothing
        top = torch.minimum(rise, torch.sqrt((1 - aside).clamp_min(0)))
        front = top * torch.rsqrt(aside + top * top) - (aside - 1).clamp_min(0) * 1e4
        sunk = rise - _THICK
        back = sunk * torch.rsqrt(aside + sunk * sunk)
        along = right * cos + up * sin
        parts = []
        for high, low in itertools.pairwise(edges):
            most = (front.clamp_max(high) - back.clamp_min(low)).amax(1, keepdim=True)
            height = (high + low) / 2
            over = along * math.sqrt(1 - height * height) + facing * height
            above = (over * 4 + 0.5).clamp(0, 1)
            parts.append((most * (HEIGHTS / 2)).clamp(0, 1) * above)
        found.append(torch.cat(parts, 1))
    return found


def _moved(pixels: Sequence[Tensor], step: int, azimuth: int) -> Tensor:
    """Of each cell the pixel that is `step` pixels away from the one taken; without the margin."""
    cos, sin = _turn(azimuth)
    down, row = divmod(TAKEN - round(step * sin), CELL)
    right, column = divmod(TAKEN + round(step * cos), CELL)
    wide = pixels[row * CELL + column]
    return F.pad(wide, (-REACH - right, right - REACH, -REACH - down, down - REACH))


def _turn(azimuth: int) -> tuple[float, float]:
    angle = 2 * math.pi * azimuth / AZIMUTHS
    return math.cos(angle), math.sin(angle)


def sectors() -> tuple[Float64, float]:
    """Their directions (SECTORS, 3) in a cell's frame, and the solid angle of each."""
    height = 1 - (np.arange(HEIGHTS) + 0.5) * (2 / HEIGHTS)
    angle = np.arange(AZIMUTHS)[:, None] * (2 * math.pi / AZIMUTHS)
    side = np.sqrt(1 - height * height)
    toward = np.stack([np.cos(angle) * side, np.sin(angle) * side, height + 0 * angle], 2)
    return toward.reshape(-1, 3), 4 * math.pi / SECTORS


@lru_cache(maxsize=1)
def nodes() -> tuple[Float64, Float64]:
    """Directions to look light up in, (nodes, SECTORS, 3) in camera space, and what makes
    coefficients of it (TERMS, nodes): the least-squares fit."""
    side = np.linspace(-_SIDE, _SIDE, 7)
    places = np.stack(np.meshgrid(side, side), 2).reshape(-1, 2)
    places = places[(places**2).sum(1) < 1.07 * _SIDE**2]
    eyes = np.column_stack([places, np.sqrt(1 - (places**2).sum(1))])
    toward = torch.from_numpy(sectors()[0].T)[None, :, :, None, None]
    turned = out_of_frame(torch.from_numpy(eyes)[:, :, None, None, None], toward)
    powers = _powers(torch.from_numpy(places.T)[None])[0].numpy()
    return turned[:, :, :, 0, 0].numpy().transpose(0, 2, 1), np.linalg.pinv(powers.T)


def place(eye: Tensor) -> Tensor:
    """(N, 3, h, w) to the polynomials' terms (N, TERMS, h, w); beyond `_SIDE` those at it."""
    aside = eye[:, :2]
    length = torch.sqrt((aside * aside).sum(1, keepdim=True) + _TINY)
    return _powers(aside * (_SIDE / length).clamp_max(1))


def _powers(at: Tensor) -> Tensor:
    """x^i y^j up to `_DEGREE`: (N, 2, …) to (N, TERMS, …)."""
    x, y = torch.split(at, 1, 1)
    rows = [[torch.ones_like(x)]]
    for _ in range(_DEGREE):
        rows.append([rows[-1][0] * x, *(term * y for term in rows[-1])])
    return torch.cat([term for row in rows for term in row], 1)
