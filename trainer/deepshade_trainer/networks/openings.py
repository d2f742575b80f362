"""Light from all around: geometry decides what is blocked in each direction."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade.tensors import channel_slices
from deepshade_trainer.networks import slices
from deepshade_trainer.networks.fold_unet import FoldConfig, FoldUNet
from deepshade_trainer.networks.horizons import covered, unit
from deepshade_trainer.networks.network import Network, constant, full_precision
from deepshade_trainer.networks.receptive_field import Span, folded, grown, joined
from deepshade_trainer.networks.reflections import blurred, mean, turned

# what a graph takes, in this order
ATTRIBUTES = ("normal_world", "normal", "position")
_LEVEL = 5  # the map is seen through lobes of exponent 2^LEVEL
_SURFACE = 0.25  # the square of a normal's length; background has none
_APART = 0.025  # distances from a pixel's plane at which a cell no longer tells of it, over depth
_SMOOTHED = 0.15  # effect radii from which on cells don't lend each other what is blocked
_TRUST = 0.8  # in `ao` of the trunk against W: so that a white map gives `ao` to .01
_MOST = 4.0  # what is blocked is multiplied by at most that, to be as much as `ao` says
_LEAST = 0.02  # of that which is blocked, to be multiplied


@dataclass(frozen=True)
class OpeningsConfig:
    """The shape of the trunk, and the short hash of the bundle that its weights are `of`."""

    kind: str = "openings"
    inputs: int = 9
    outputs: int = 3
    trunk: FoldConfig = field(default_factory=FoldConfig)
    of: str = ""


class Openings(Network):
    """Light from all around (N, 3, H, W), less what the surroundings of a surface block of it.

    I is the irradiance over π of the open surface, looked up. Of it

        B = Σ_k c_k Ω/π N·ω_k E_k

    is blocked: ω_k are the sectors of the slices through a cell (`slices`), Ω their solid angle,
    E_k the map through a lobe about ω_k, c_k how much of each is blocked. A pixel has B from the
    cells around it that lie in its plane; and W, the same of a white map. The trunk, that of
    ambient occlusion, says how much light is left under a white one, `ao`: an estimate as good as
    1 - W, with errors of its own. The answer has a weighted geometric mean of both:

        I - B ((1 - ao) / W)^t

    It is linear in the map. Where there is no surface stands the map's mean.
    """

    linear = True
    rounded = "trunk."
    calculated = True
    environment = ("lobes", "turn", "camera")
    towards: Tensor
    fit: Tensor
    cosines: Tensor

    def __init__(self, config: OpeningsConfig) -> None:
        super().__init__()
        self.trunk = FoldUNet(config.trunk)
        self.places = channel_slices(ATTRIBUTES, False)
        toward, fit = slices.nodes()
        for name, value in (
            ("towards", toward.reshape(1, -1, 3).transpose(0, 2, 1)[..., None]),
            ("fit", fit),
            ("cosines", slices.sectors()[0].T * (slices.sectors()[1] / math.pi)),
        ):
            buffer = torch.from_numpy(np.ascontiguousarray(value, np.float32))
            self.register_buffer(name, buffer, persistent=False)

    @property
    def size_multiple(self) -> int:
        """See `Network.size_multiple`."""
        return math.lcm(self.trunk.size_multiple, slices.CELL)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        cell = pixel // slices.CELL
        seen = folded(grown((cell, cell), 2 + slices.REACH), slices.CELL)  # by the cells around
        return joined(seen, self.trunk.receptive_field(pixel))

    def forward(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(1, 9, H, W), the table of `environments.lobes`, the turns from world and from camera to
        the map (3, 3), to (1, 3, H, W)."""
        lobes, turn, camera = given
        first, last = self.places["normal"].start, self.places["position"].stop
        occlusion = self.trunk(gbuffer, first).clamp(0, 1)
        with full_precision():
            covers = covered(gbuffer[:, last - 1 : last])
            normal = gbuffer[:, self.places["normal_world"]]
            surface = ((normal * normal).sum(1, keepdim=True) > _SURFACE) & (covers > 0)
            irradiance = blurred(lobes, turned(normal, turn), 0)
            irradiance = torch.where(surface, irradiance, mean(lobes))
            through = blurred(lobes, turned(self.towards, camera), _LEVEL)
            through = self.fit @ through.reshape(1, 3, -1, slices.SECTORS)
            pixels = F.pixel_unshuffle(gbuffer[:, first:last], slices.CELL)
            pixels = pixels.reshape(len(pixels), 6, slices.CELL**2, *pixels.shape[2:])
            at = pixels[:, :, slices.TAKEN * (slices.CELL + 1)]
            at = torch.cat([unit(at[:, :3]), at[:, 3:], covered(at[:, 5:])], 1)
            blocked = torch.cat(slices.slices(pixels, at), 1)  # (1, SECTORS, h, w)
            vectors = _smoothed(at, self._gathered(at, blocked, through))  # (1, 3, 4, h, w)
            less = _at_pixels(pixels, at, vectors)
            less, white = less[:, :-1], less[:, -1:]
            ratio = ((1 - occlusion) / white.clamp_min(_LEAST)).clamp(_LEAST**2, _MOST)
            answer: Tensor = irradiance - less * ratio**_TRUST * covers
            return answer

    def _gathered(self, at: Tensor, blocked: Tensor, through: Tensor) -> Tensor:
        """Σ_k c_k Ω_k/π ω_k E_k in camera space, (N, 3, C + 1, h, w); the last for a white map."""
        count, colours = through.shape[:2]
        high, wide = at.shape[2:]
        eye, flat = slices.toward_eye(at[:, 3:6]), blocked.flatten(2)
        weights = through[:, None] * self.cosines[None, :, None, None]  # (N, 3, C, TERMS, SECTORS)
        told = weights.reshape(count, -1, slices.SECTORS) @ flat
        told = told.reshape(count, 3, colours, slices.TERMS, high, wide)
        light = (told * slices.place(eye)[:, None, None]).sum(3)
        white = (self.cosines @ flat).reshape(count, 3, 1, high, wide)
        vectors = torch.cat([light, white], 2) * at[:, None, 6:]
        return slices.out_of_frame(eye[:, :, None], vectors)

    def prepare_export(self) -> None:
        """See `Network.prepare_export`."""
        self.trunk.prepare_export()


def _at_pixels(folded: Tensor, at: Tensor, vectors: Tensor) -> Tensor:
    """N·v at each pixel (N, C, H, W), of the v (N, 3, C, h, w) of the four cells around it.

    Each counts by how near the pixel it was taken (the third of four each way), how near to the
    pixel's plane, and how its normal agrees.
    """
    count, _, colours, high, wide = vectors.shape
    folded = folded.reshape(count, 6, 4, 4, high, wide)
    around = F.pad(torch.cat([at, vectors.flatten(1, 2)], 1), (1, 1, 1, 1))
    rows = []
    for top in (0, 2):  # the same four cells are around all pixels of a quarter of a cell
        row = []
        for left in (0, 2):
            quarter = folded[:, :, top : top + 2, left : left + 2].reshape(count, 6, 4, high, wide)
            found = _of_quarter(quarter, around, top, left, colours)
            row.append(found.reshape(count, colours, 2, 2, high, wide))
        rows.append(torch.cat(row, 3))
    return F.pixel_shuffle(torch.cat(rows, 2).reshape(count, colours * 16, high, wide), 4)


def _of_quarter(quarter: Tensor, around: Tensor, top: int, left: int, colours: int) -> Tensor:
    """The same (N, C, 4, h, w) for the 2 x 2 pixels (N, 6, 4, h, w) from (top, left) in a cell."""
    normal, position = quarter[:, :3], quarter[:, 3:]
    nx, ny, nz = torch.split(normal, 1, 1)
    normal = normal * torch.rsqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    nx, ny, nz = torch.split(normal, 1, 1)  # (N, 1, 4, h, w)
    total = sums = torch.zeros((), device=quarter.device)
    for down in (0, 1):
        for right in (0, 1):
            first, second = down + top // 2, right + left // 2
            there = F.pad(around, (-second, second - 2, -first, first - 2))[:, :, None]
            shares = [
                _share(top + i, down) * _share(left + j, right) for i in (0, 1) for j in (0, 1)
            ]
            near = constant(shares, quarter)[:, None, None] + 0.02
            weight = near * _agreement(normal, position, there) + 1e-5 * there[:, 6:7]
            vx, vy, vz = torch.split(there[:, 7:], colours, 1)  # (N, C, 1, h, w)
            sums = sums + (vx * nx + vy * ny + vz * nz) * weight
            total = total + weight
    return sums / (total + 1e-9)


def _smoothed(at: Tensor, vectors: Tensor) -> Tensor:
    """Each cell's v (N, 3, C, h, w) with those of the eight around it that lie in its plane."""
    normal, position = at[:, :3], at[:, 3:6]
    around = F.pad(torch.cat([at, vectors.flatten(1, 2)], 1), (1, 1, 1, 1))
    total = sums = torch.zeros((), device=at.device)
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            there = F.pad(around, (-right, right - 2, -down, down - 2))
            near = (2 - abs(down - 1)) * (2 - abs(right - 1)) / 4
            x, y, z = torch.split(there[:, 3:6] - position, 1, 1)
            close = F.relu(1 - (x * x + y * y + z * z) * (1 / _SMOOTHED**2))
            weight = _agreement(normal, position, there) * close * near
            sums = sums + there[:, 7:] * weight
            total = total + weight
    return (sums / (total + 1e-9)).reshape(vectors.shape)


def _agreement(normal: Tensor, position: Tensor, there: Tensor) -> Tensor:
    """How far what is `there` (N, 7 or more, …) lies in the planes of (N, 3, …); 1 if it does."""
    nx, ny, nz = torch.split(normal, 1, 1)
    x, y, z = torch.split(position, 1, 1)
    mx, my, mz, there_x, there_y, there_z, coverage = torch.split(there[:, :7], 1, 1)
    agrees = (mx * nx + my * ny + mz * nz).clamp_min(0)
    agrees = agrees * agrees
    beside = (there_x - x) * nx + (there_y - y) * ny + (there_z - z) * nz
    apart = z * _APART
    flat = F.relu(1 - beside * beside / (apart * apart).clamp_min(1e-12))
    return flat * flat * (agrees * agrees) * coverage


def _share(row: int, second: int) -> float:
    """Bilinear between the cells around a pixel of a row of four, of which the third was taken."""
    part = (row - 2) / 4 % 1
    return part if second else 1 - part
