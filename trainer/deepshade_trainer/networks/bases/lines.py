"""Bases of motion blur: what each moment of the exposure shows, found along lines of motion.

A pixel's exposure is cut into moments. At moment t a surface that moves by F covers the pixel if it
lies F t before it. Two lines are searched: along the pixel's own motion, and along the largest
motion nearby that reaches it (tiles as in M. McGuire, P. Hennessy, M. Bukowski and B. Osman, *A
Reconstruction Filter for Plausible Motion Blur*, I3D 2012; two directions as in J.-P. Guertin,
M. McGuire and D. Nowrouzezahrai, *A Fast and Stable Feature-Aware Motion Blur Filter*, HPG 2014).
Unlike there, moments are composited one by one, near over far, and what covers nothing is what the
own surface uncovers.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.horizons import sampled
from deepshade_trainer.networks.receptive_field import Span

# Pixels along the side of a tile that has one largest motion.
_TILE = 16
# How many tiles away a motion is looked for: half of the largest motion, 64 pixels.
_TILES = 2
_LONGEST = 64.0
# Sharpness of near against far, per doubling of the depth; where background is, in doublings.
_SHARP, _FAR, _NEAR = 24.0, 12.0, -8.0
# How little the sharp pixel counts until a network learns more.
_SHARE = 2e-3


class Lines(Bases):
    """Light along lines of motion: of (motion, light, depth) (N, 6, H, W).

    `moments` is into how many the exposure is cut. Squares of 2 x 2 pixels are gathered together:
    they share their lines, and a quarter of the copies is what engines are quick at.
    """

    told = 12
    weights = 4
    size_multiple = _TILE

    squares: Tensor

    def __init__(self, moments: int = 8) -> None:
        super().__init__()
        self.moments = moments
        # Each pixel's square: itself, right, below, below right; four of each channel.
        squares = torch.zeros(12, 3, 2, 2)
        for channel in range(12):
            squares[channel, channel // 4, channel % 4 // 2, channel % 2] = 1
        self.register_buffer("squares", squares, persistent=False)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`. Nothing here is learnt."""
        with torch.no_grad():
            return self._features(gbuffer)

    def _features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        motion, light, depth = torch.split(gbuffer, [2, 3, 1], 1)
        motion = motion.clamp(-_LONGEST, _LONGEST)
        far = _doublings(depth)
        count, _, height, width = gbuffer.shape
        h, w = height // 2, width // 2
        # A table each: engines copy whole rows much quicker than they split them afterwards.
        rows_u, rows_v, rows_far = (
            self._table(plane) for plane in (motion[:, :1], motion[:, 1:], far)
        )
        rows_light = self._table(light)
        x = torch.arange(w, device=gbuffer.device, dtype=torch.float32) * 2
        y = torch.arange(h, device=gbuffer.device, dtype=torch.float32)[:, None] * 2
        first = torch.arange(count, device=gbuffer.device)[:, None, None] * (height * width)
        own = sampled(motion, 2, 0)  # (N, 2, h, w)
        strong = self._strongest(own)  # (N, 2, h, w)

        def tap(line: Tensor, moment: float) -> tuple[Tensor, Tensor, Tensor]:
            """Whether it covers (M, 4), its depth (M, 4), its light (M, 3, 4)."""
            u, v = line[:, 0], line[:, 1]
            column = (x - u * moment).round().clamp(0, width - 2)
            row = (y - v * moment).round().clamp(0, height - 2)
            at = (first + row.long() * width + column.long()).reshape(-1)
            aside = rows_u[at] - u.reshape(-1, 1)
            below = rows_v[at] - v.reshape(-1, 1)
            miss = (aside * aside + below * below + 1e-12).sqrt() * abs(moment)
            length = (u * u + v * v + 1e-12).sqrt().reshape(-1, 1)
            covers = (2 - miss / (length * (0.2 * abs(moment)) + 1)).clamp(0, 1)
            return covers, rows_far[at], rows_light[at].reshape(-1, 3, 4)

        here = F.conv2d(far, self.squares[:4, :1], stride=2).permute(0, 2, 3, 1).reshape(-1, 4)
        over, mine, gone, beyond = [], [], [], []
        for k in range(self.moments):
            moment = (k + 0.5) / self.moments - 0.5
            a, near, passing = tap(strong, moment)
            b, same, carried = tap(own, moment)
            front = ((same - near) * _SHARP + 0.5).clamp(0, 1)
            one = a * (1 - b * (1 - front))
            two = b * (1 - a * front)
            left = (1 - b) * (((same - here) * _SHARP + 1).clamp(0, 1) + 1e-2)
            over.append((one, passing))
            mine.append((two, carried))
            beyond.append((left, carried))
            gone.append(left)

        def gathered(taps: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
            weight = torch.zeros_like(taps[0][0])
            total = torch.zeros_like(taps[0][1])
            for share, colour in taps:
                weight = weight + share
                total = total + share[:, None] * colour
            return weight, total

        def whole(cells: Tensor) -> Tensor:
            """(M, 4) or (M, C, 4) to (N, C, H, W)."""
            return F.pixel_shuffle(cells.reshape(count, h, w, -1).permute(0, 3, 1, 2), 2)

        weight_over, light_over = gathered(over)
        weight_mine, light_mine = gathered(mine)
        weight_left, light_left = gathered(beyond)
        scale = 1 / self.moments
        covers, mines, lefts, passing, carried, uncovered = (
            whole(cells * scale)
            for cells in (
                weight_over,
                weight_mine,
                weight_left,
                light_over,
                light_mine,
                light_left,
            )
        )
        rest = (1 - covers - mines).clamp_min(0)
        uncovered = (uncovered + light * 1e-4) / (lefts + 1e-4)
        told = torch.cat(
            [
                covers,
                mines,
                rest,
                lefts,
                _line(motion),
                F.interpolate(_line(strong), scale_factor=2.0, mode="nearest"),
                ((far - _NEAR) / (_FAR - _NEAR)),
                (depth > 1e-6).to(depth.dtype),
            ],
            1,
        )
        return told, (light, covers, passing, mines, carried, rest, uncovered)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        light, covers, passing, mines, carried, rest, uncovered = state
        a, b, c, d = torch.split((torch.tanh(weights * 0.2) * 5).exp(), 1, 1)
        c, d = c * (rest + 1e-4), d * _SHARE
        total = passing * a + carried * b + uncovered * c + light * d
        return total / (covers * a + mines * b + c + d)

    def _table(self, planes: Tensor) -> Tensor:
        """The squares that begin at each pixel of (N, C, H, W): (N H W, 4 C)."""
        channels = planes.shape[1]
        squares = self.squares[: 4 * channels, :channels]
        return (
            F.conv2d(F.pad(planes, (0, 1, 0, 1)), squares)
            .permute(0, 2, 3, 1)
            .reshape(-1, 4 * channels)
        )

    def _strongest(self, own: Tensor) -> Tensor:
        """Per 2 x 2 pixels (N, 2, h, w) the motion nearby that reaches farthest."""
        size = _TILE // 2
        square = (own * own).sum(1, keepdim=True)
        most = F.max_pool2d(square, size)
        wide = F.interpolate(most, scale_factor=float(size), mode="nearest")
        chosen = (square >= wide).to(own.dtype)
        tiles = F.avg_pool2d(torch.cat([own * chosen, chosen], 1), size)
        motion = tiles[:, :2] / tiles[:, 2:].clamp_min(1e-6)  # (N, 2, H / 16, W / 16)
        reach = most.sqrt() / 2
        side = 2 * _TILES + 1
        height, width = reach.shape[2:]
        cells = F.pad(torch.cat([motion, reach + 1], 1), (_TILES,) * 4)
        best = torch.full_like(reach, -1e3)
        found = torch.zeros_like(motion)
        for j in range(side):
            for i in range(side):
                there = cells[:, :, j : j + height, i : i + width]
                ring = max(abs(i - _TILES), abs(j - _TILES))
                # of equals, the nearer
                away = max(0, ring - 1) * _TILE + 0.5 * ring
                score = there[:, 2:] - away
                better = (score > best).to(own.dtype)
                best = torch.maximum(best, score)
                found = found + (there[:, :2] - found) * better
        return F.interpolate(found, scale_factor=float(size), mode="nearest")

    def receptive_field(self, pixel: int) -> Span:
        """See `Bases.receptive_field`."""
        reach = int(_LONGEST / 2) + 2
        tile = pixel // _TILE * _TILE
        return (
            min(pixel - reach, tile - _TILES * _TILE),
            max(pixel + reach, tile + (_TILES + 1) * _TILE - 1),
        )


def _doublings(depth: Tensor) -> Tensor:
    """Depths in doublings of the median, from nearest to background, which is farthest."""
    background = (depth <= 1e-6).to(depth.dtype) * 1e6
    return (depth.clamp_min(1e-6) + background).log2().clamp(_NEAR, _FAR)


def _line(motion: Tensor) -> Tensor:
    """A motion (N, 2, …) as a line without a sense (N, 3, …): (u² − v², 2uv) / |F|, and |F|."""
    u, v = torch.split(motion, 1, 1)
    length = (u * u + v * v + 1e-6).sqrt()
    return torch.cat([(u * u - v * v) / length, 2 * u * v / length, length], 1) / 16
