"""Bases of motion blur: what each moment of the exposure shows, found along lines of motion.

A pixel's exposure is cut into moments. At moment t a surface that moves by F covers the pixel if it
lies F t before it. Two lines are searched: along the pixel's own motion, and along the largest
motion nearby that reaches it (tiles as in M. McGuire, P. Hennessy, M. Bukowski and B. Osman, *A
Reconstruction Filter for Plausible Motion Blur*, I3D 2012; two directions as in J.-P. Guertin,
M. McGuire and D. Nowrouzezahrai, *A Fast and Stable Feature-Aware Motion Blur Filter*, HPG 2014).
Unlike there, moments are composited one by one, near over far, and what covers nothing is what the
own surface uncovers. Along their own motion neighbouring pixels look at moments that lie half-way
between each other's, as squares of a chessboard, and the mean along it is shown, so that edges and
bright spots come in half as coarse steps.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.horizons import sampled
from deepshade_trainer.networks.receptive_field import Span, folded, joined

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

    `moments` is into how many the exposure is cut.
    """

    told = 11
    weights = 4
    size_multiple = _TILE
    cell = 2
    reach = 1

    def __init__(self, moments: int = 8) -> None:
        super().__init__()
        self.moments = moments

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`. Nothing here is learnt."""
        with torch.no_grad():
            return self._features(gbuffer)

    def _features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        motion, light, depth = torch.split(gbuffer, [2, 3, 1], 1)
        motion = motion.clamp(-_LONGEST, _LONGEST)
        far = _doublings(depth)
        half = sampled(motion, 2, 0)  # (N, 2, H / 2, W / 2)
        tiles = self._strongest(half)  # (N, 2, H / 16, W / 16)
        strong = F.interpolate(tiles, scale_factor=float(_TILE), mode="nearest")
        scene = torch.cat([motion, far, light], 1)
        passes = _Line(scene, strong)
        stays = _Line(scene, motion, _chessboard(far) * (0.5 / self.moments))
        sums = [torch.zeros_like(far) for _ in range(3)]
        lights = [torch.zeros_like(light) for _ in range(3)]
        for k in range(self.moments):
            moment = (k + 0.5) / self.moments - 0.5
            a, near, passing = passes.at(moment)
            b, same, carried = stays.at(moment)
            front = ((same - near) * _SHARP + 0.5).clamp(0, 1)
            uncovers = (1 - b) * (((same - far) * _SHARP + 1).clamp(0, 1) + 1e-2)
            shares = a * (1 - b * (1 - front)), b * (1 - a * front), uncovers
            for n, colour in enumerate((passing, carried, carried)):
                sums[n] = sums[n] + shares[n]
                lights[n] = lights[n] + shares[n] * colour
        covers, mines, lefts = (each / self.moments for each in sums)
        passing, carried, uncovered = (each / self.moments for each in lights)
        rest = (1 - covers - mines).clamp_min(0)
        uncovered = (uncovered + light * 1e-4) / (lefts + 1e-4)
        place = (sampled(far, 2, 0) - _NEAR) / (_FAR - _NEAR)
        told = [
            F.avg_pool2d(torch.cat([covers, mines, lefts], 1), 2),
            _line(half),
            F.interpolate(_line(tiles), scale_factor=_TILE / 2, mode="nearest"),
            place,
            (place < 1).to(place.dtype),
        ]
        return torch.cat(told, 1), (light, covers, passing, mines, carried, rest, uncovered, motion)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        light, covers, passing, mines, carried, rest, uncovered, motion = state
        gains = (torch.tanh(weights * 0.2) * 5).exp()
        a, b, c, d = (
            F.interpolate(gain, scale_factor=2.0, mode="nearest")
            for gain in torch.split(gains, 1, 1)
        )
        c, d = c * (rest + 1e-4), d * _SHARE
        total = passing * a + carried * b + uncovered * c + light * d
        shown = total / (covers * a + mines * b + c + d)
        return _smoothed(shown, motion * (1 / self.moments))

    def _strongest(self, own: Tensor) -> Tensor:
        """Per tile, of every second pixel's motion (N, 2, h, w), the one that reaches farthest."""
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
        return found

    def receptive_field(self, pixel: int) -> Span:
        """See `Bases.receptive_field`."""
        first, last = pixel - self.reach, pixel + self.reach
        along = int(_LONGEST / 2) + 2
        tiles = first // _TILE - _TILES, last // _TILE + _TILES
        return joined((first - along, last + along), folded(tiles, _TILE))


class _Line:
    """What each pixel of a scene (motion, far, light) (N, 6, H, W) finds along a motion.

    Offsets are whole pixels, so that no two engines round what lies between two differently. A
    pixel's moments are `shift` (1, 1, H, W) later, or earlier where its motion has the other sense:
    both senses find the same.
    """

    def __init__(self, scene: Tensor, motion: Tensor, shift: Tensor | None = None) -> None:
        u, v = torch.split(motion, 1, 1)
        self.scene, self.motion = scene, (u, v)
        self.length = (u * u + v * v).sqrt()
        x, y = (
            torch.arange(size, device=scene.device, dtype=scene.dtype) + 0.5
            for size in (scene.shape[3], scene.shape[2])
        )
        self.place = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (H, W, 2)
        self.scale = 2 / (self.place[-1:, -1:] + 0.5)
        self.last = motion.permute(0, 2, 3, 1)
        self.start: Tensor | None = None
        if shift is not None:
            sense = ((u + v * 1e-4) >= 0).to(shift.dtype) * 2 - 1
            self.start = self.last * (sense * shift).permute(0, 2, 3, 1)

    def at(self, moment: float) -> tuple[Tensor, Tensor, Tensor]:
        """Whether what moves over the pixel then covers it (N, 1, H, W), how far it is, its light.

        It covers in full where it misses by less than is allowed, and from twice that on not.
        """
        offset = self.last * moment
        if self.start is not None:
            offset = offset + self.start
        grid = (self.place - offset.round()) * self.scale - 1
        found = F.grid_sample(
            self.scene, grid, mode="nearest", padding_mode="border", align_corners=False
        )
        *motion, far, light = torch.split(found, [1, 1, 1, 3], 1)
        u, v = (there - own for there, own in zip(motion, self.motion, strict=True))
        miss = u * u + v * v
        allowed = abs(moment) / (self.length * (0.2 * abs(moment)) + 1)
        return ((4 - miss * (allowed * allowed)) / 3).clamp(0, 1), far, light


def _chessboard(like: Tensor) -> Tensor:
    """-.5 and .5 on the squares of a chessboard (1, 1, H, W)."""
    height, width = like.shape[2:]
    rows, columns = (
        torch.arange(size, device=like.device, dtype=like.dtype) * 0.5 for size in (height, width)
    )
    both = rows[:, None] + columns
    return ((both - both.floor()) * 2 - 0.5)[None, None]


def _smoothed(shown: Tensor, step: Tensor) -> Tensor:
    """Colours (N, 3, H, W), the mean with both neighbours along a motion.

    `step` (N, 2, H, W) is what moves between two moments; in part where that is under a pixel.
    """
    right, down = torch.split(step.abs(), 1, 1)
    lies = (right >= down).to(step.dtype)
    share = torch.maximum(right, down).clamp(max=1) * 0.25
    across, along = lies * share, (1 - lies) * share
    right = shown[:, :, :, 1:] - shown[:, :, :, :-1]
    down = shown[:, :, 1:] - shown[:, :, :-1]
    beside = (F.pad(right, (0, 1)) - F.pad(right, (1, 0))) * across
    return shown + beside + (F.pad(down, (0, 0, 0, 1)) - F.pad(down, (0, 0, 1, 0))) * along


def _doublings(depth: Tensor) -> Tensor:
    """Depths in doublings of the median, from nearest to background, which is farthest."""
    background = (depth <= 1e-6).to(depth.dtype) * 1e6
    return (depth.clamp_min(1e-6) + background).log2().clamp(_NEAR, _FAR)


def _line(motion: Tensor) -> Tensor:
    """A motion (N, 2, …) as a line without a sense (N, 3, …): (u² − v², 2uv) / |F|, and |F|."""
    u, v = torch.split(motion, 1, 1)
    length = (u * u + v * v + 1e-6).sqrt()
    return torch.cat([(u * u - v * v) / length, 2 * u * v / length, length], 1) / 16
