"""Image-based lighting without training: look-ups in an environment blurred by lobes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade.environments.lobes import HEIGHT, LEVELS, TILES, WIDTH
from deepshade.tensors import channel_slices
from deepshade_trainer.networks import phong
from deepshade_trainer.networks.network import Network
from deepshade_trainer.networks.receptive_field import Span

# atan(x) / x in powers of x², for |x| <= 1: a least-squares fit, within 2e-6
_ATAN = np.polynomial.polynomial.polyfit(
    (x := np.cos(np.linspace(0, np.pi / 2, 400))[:-1]) ** 2, np.arctan(x) / x, 7
)
# of a surface under an environment: what a graph takes, in this order
ATTRIBUTES = ("normal_world", "view", "diffuse", "specular", "gloss")
_SURFACE = 0.25  # the square of a normal's length; background has none
_TINY = 1e-12
_SHARP = len(TILES) - 1  # the tile of the map itself

Number = Tensor | int


@dataclass(frozen=True)
class ReflectionsConfig:
    """How many lobes, 1 or 2, Phong's is replaced by."""

    kind: str = "reflections"
    inputs: int = 13
    outputs: int = 3
    lobes: int = 1


class Reflections(Network):
    """A G-buffer (`ATTRIBUTES`), an environment's table and a turn to radiance,
    R_diff A(N, 1) + R_spec ∫ K L dω.

    K, Phong's lobe over a surface, is replaced by one or two lobes (`phong`). Where there is no
    surface stands the environment behind it; where the view isn't known there, its mean.
    """

    linear = True
    rounded = None
    calculated = True
    environment = ("lobes", "turn")
    size_multiple = 1

    fits: Tensor
    row: Tensor
    column: Tensor
    rows: Tensor

    def __init__(self, config: ReflectionsConfig | None = None) -> None:
        super().__init__()
        self.lobes = lobes = config.lobes if config else 1
        self.places = channel_slices(ATTRIBUTES, False)
        self.register_buffer("fits", torch.from_numpy(phong.table(lobes))[None], persistent=False)
        corners = np.array([(tile.row, tile.column, tile.rows) for tile in TILES], np.float32)
        for name, column in zip(("row", "column", "rows"), corners.T, strict=True):
            self.register_buffer(name, torch.from_numpy(column.copy()), persistent=False)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        return pixel, pixel

    def forward(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(1, 13, H, W), a table (1, 3, HEIGHT, WIDTH) and a turn (3, 3) to radiance
        (1, 3, H, W)."""
        table, turn = given
        normal, view, diffuse, specular, gloss = (gbuffer[:, at] for at in self.places.values())
        square = _dot(normal, normal)
        surface = square > _SURFACE
        normal = turned(normal, turn) * torch.rsqrt(square.clamp_min(_TINY))
        view = turned(view, turn)
        unseen = _dot(view, view) < _SURFACE
        mu = _dot(normal, view).clamp(-1, 1)
        mirrored = 2 * mu * normal - view  # background, whose normal is 0, looks straight on
        gloss = gloss.clamp(0, 2.0 ** (LEVELS - 1) - 1)
        fit = self._fit(mu, gloss)
        share = torch.where(surface, fit[:, 0:1] + mu.clamp_min(0), 1)
        level = (torch.log2(gloss + 1) + fit[:, 3:4]).clamp(0, LEVELS - 1)
        index = torch.floor(level).clamp_max(LEVELS - 2)
        part = torch.where(surface, level - index, 0)
        # the mean lies before the levels
        index = torch.where(surface, index + 1, torch.where(unseen, 0.0, float(_SHARP)))
        towards = fit[:, 1:2] * mirrored + fit[:, 2:3] * normal
        if self.lobes == 1:
            seen = self._between(table, towards, index, part)
        else:
            aside = fit[:, 4:5] * torch.cross(normal, mirrored, dim=1)
            seen = self._between(table, towards + aside, index, part)
            seen = 0.5 * (seen + self._between(table, towards - aside, index, part))
        shine = torch.where(surface, specular, 1) * (share.clamp_min(0) * seen)
        spread = blurred(table, normal, 0)
        return diffuse * spread + shine

    def _fit(self, mu: Tensor, gloss: Tensor) -> Tensor:
        """(1, 4 or 5, H, W): see `phong.table`."""
        stretch = (gloss + 1) / 8
        x = mu * torch.sqrt((1 + stretch) / (1 + stretch * mu * mu))
        y = torch.log2(gloss + 1) * (4 / (phong.ROWS - 1)) - 1
        return _sampled(self.fits, x, y, align_corners=True)

    def _between(self, table: Tensor, towards: Tensor, index: Tensor, part: Tensor) -> Tensor:
        """The look-up in two tiles (`index` and the next), blended by `part`."""
        angles = _angles(towards)
        pair = []
        for place in (index, (index + 1).clamp_max(_SHARP)):
            number = place.long()
            pair.append(
                _look(table, angles, self.row[number], self.column[number], self.rows[number])
            )
        return pair[0] + (pair[1] - pair[0]) * part


def blurred(table: Tensor, directions: Tensor, level: int) -> Tensor:
    """A(d, 2^level) (1, 3, H, W) for `directions` (1, 3, H, W) of the map, of any length but 0."""
    tile = TILES[1 + level]
    return _look(table, _angles(directions), tile.row, tile.column, tile.rows)


def mean(table: Tensor) -> Tensor:
    """(1, 3, 1, 1): the map's mean."""
    tile = TILES[0]
    return table[:, :, tile.row : tile.row + 1, tile.column : tile.column + 1]


def _look(
    table: Tensor, angles: tuple[Tensor, Tensor], row: Number, column: Number, rows: Number
) -> Tensor:
    """(1, 3, H, W): a tile of the table, or one for each pixel, at `_angles`."""
    u, v = angles
    x = (column + 2 * rows * u) * (2 / WIDTH) - 1
    y = (row + rows * v) * (2 / HEIGHT) - 1
    return _sampled(table, x, y, align_corners=False)


def _sampled(picture: Tensor, x: Tensor, y: Tensor, *, align_corners: bool) -> Tensor:
    """Bilinear samples (1, C, H, W) of (1, C, h, w) at x and y (1, 1, H, W) in [-1, 1]."""
    grid = torch.cat([x, y], dim=1).permute(0, 2, 3, 1)  # much quicker than to stack them last
    return F.grid_sample(picture, grid, padding_mode="border", align_corners=align_corners)


def _angles(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where a direction (1, 3, H, W) lies in a map: u and v in [0, 1] (`Environment`)."""
    x, y, z = direction[:, 0:1], direction[:, 1:2], direction[:, 2:3]
    u = _atan2(x, -z) * (0.5 / math.pi) + 0.5
    v = _atan2(torch.sqrt(x * x + z * z), y) * (1 / math.pi)
    return u, v


def _atan2(y: Tensor, x: Tensor) -> Tensor:
    """By a polynomial: few engines have the function, or a quick one."""
    a, b = y.abs(), x.abs()
    ratio = torch.minimum(a, b) / torch.maximum(a, b).clamp_min(_TINY)
    square = ratio * ratio
    angle = torch.full_like(square, float(_ATAN[-1]))
    for factor in _ATAN[-2::-1]:
        angle = angle * square + float(factor)
    angle = angle * ratio
    angle = torch.where(a > b, math.pi / 2 - angle, angle)
    angle = torch.where(x < 0, math.pi - angle, angle)
    return torch.where(y < 0, -angle, angle)


def turned(vectors: Tensor, turn: Tensor) -> Tensor:
    """(1, 3, H, W) by a (3, 3) matrix."""
    columns = turn.reshape(1, 3, 3, 1, 1)
    return sum(columns[:, :, k] * vectors[:, k : k + 1] for k in range(3))  # type: ignore[return-value]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """(1, 1, H, W)."""
    c = a * b
    return c[:, 0:1] + c[:, 1:2] + c[:, 2:3]
