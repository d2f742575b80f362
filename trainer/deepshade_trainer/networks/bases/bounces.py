"""Indirect light: what the surfaces in the picture send, gathered along rays over the picture.

Around each cell of 8 x 8 pixels points are looked at in eight directions, at distances that grow
geometrically. The sector that a point newly raises above the horizon so far it fills with its light
(B. Mayaux, *Horizon-Based Indirect Lighting*, 2018; slices through the view as in J. Jimenez,
X. Wu, A. Pesce and A. Jarabo, *Practical Real-Time Strategies for Accurate Indirect Occlusion*,
2016). A sector's ∫ ω dω has a closed form, so that a cell carries each colour's vector irradiance
(J. Arvo, *The Irradiance Jacobian for Partially Occluded Polyhedral Sources*, 1994), and every
pixel takes from it by its own normal.

Two networks correct that, and both begin with nothing to correct: one along each ray, which is
told all of its points and scales their light (thin things, surfaces that face away, what hides
behind), and the one at every pixel that gives the weights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import reduce
from operator import add

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.horizons import covered, sampled, unit
from deepshade_trainer.networks.receptive_field import Span, folded, grown

CELL = 8
# How many cells away the points of a ray lie, and how many cells wide the square is whose mean
# light each of them sends.
RINGS = (1, 2, 3, 5, 8, 12, 17, 24, 35)
SPREADS = (1, 1, 1, 1, 3, 3, 5, 9, 9)
_DIAGONAL = math.sqrt(0.5)
# Rays in the picture: right and up.
RAYS = (
    (1.0, 0.0),
    (_DIAGONAL, _DIAGONAL),
    (0.0, 1.0),
    (-_DIAGONAL, _DIAGONAL),
    (-1.0, 0.0),
    (-_DIAGONAL, -_DIAGONAL),
    (0.0, -1.0),
    (_DIAGONAL, -_DIAGONAL),
)
_TOLD, _HIDDEN = 4, 32  # of each point; of a ray's network
_MOST = 3.0  # of the logarithm of a gain
_CAUTION = 0.1  # of the trunk's weights, so that it begins near the horizons' answer
# And of light from anywhere: where little is seen, little of it is much.
_GUESS = 0.1
_AWAY = 1e4  # effect radii
# A point reaches higher by half of what it rises, but by no more than half of this.
_STEP = 0.25
# A point this many radii away stands for nothing nearer.
_GONE, _FADE = 1.7, 4.0
# ∫ √(1 - c²) dc, an odd polynomial in c to 0.002.
_ARC = (0.9943, -0.1293, -0.0776)


class Bounces(Bases):
    """Light of one bounce; input: normal (3), position (3, effect radii), diffuse light (3).

    The trunk's weights at a pixel: the logarithm of a gain; three numbers to add to its normal; a
    share of the light that its cell sees, from wherever; and a share of the mean light within the
    radius, for what the picture doesn't show. All zero is the horizons' answer.
    """

    told = 6  # normal and position as they are: a geometric trunk tells itself the horizons
    weights = 6
    size_multiple = CELL

    def __init__(self) -> None:
        super().__init__()
        count = len(RINGS)
        last = nn.Conv2d(_HIDDEN, count, 1)
        nn.init.normal_(last.weight, std=1e-3)
        nn.init.zeros_(last.bias)  # type: ignore[arg-type]
        self.ray = nn.Sequential(nn.Conv2d(count * _TOLD, _HIDDEN, 1), nn.ReLU(), last)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        normal, position, light = torch.split(gbuffer, 3, 1)
        surface = covered(position[:, 2:])
        pooled = F.avg_pool2d(torch.cat([light * surface, surface], 1), CELL)  # (N, 4, h, w)
        six = torch.cat([normal, position], 1)
        cells = sampled(six, CELL)
        carried = self._gathered(unit(cells[:, :3]), cells[:, 3:], _spread(pooled))
        # A cell whose one point shows nothing takes what those around it have.
        valid = covered(cells[:, 5:])
        around = F.avg_pool2d(torch.cat([carried * valid, valid], 1), 3, 1, 1)
        filled = around[:, :-1] / around[:, -1:].clamp_min(1e-3)
        return six, (unit(normal), carried * valid + filled * (1 - valid))

    def _gathered(self, normal: Tensor, position: Tensor, lights: Sequence[Tensor]) -> Tensor:
        """What cells receive (N, 15, h, w) of the light of others (N, 3, h, w), at each ring.

        Of each colour: the vector irradiance's x, y and z over π, the light of all its sectors
        over 2 π, and the mean light within the radius.
        """
        size = (len(position), -1, len(RAYS), *position.shape[2:])
        across, depth = torch.split(position, [2, 1], 1)
        # Nothing is near what is far behind the camera: neither background nor what isn't there.
        here = torch.cat([across, depth + (covered(depth) * -_AWAY + _AWAY)], 1)
        view = unit(position * -1)  # to the eye
        along = torch.tensor(RAYS, dtype=normal.dtype).T.reshape(2, len(RAYS), 1, 1)
        along = along.to(normal.device)
        # The ray's direction square to the view is (along - view · slant) · upright.
        slant = (view[:, :2, None] * along).sum(1)  # (N, rays, h, w)
        upright = torch.rsqrt((1 - slant * slant).clamp_min(1e-3))
        facing = (normal * view).sum(1, keepdim=True).clamp_min(0.02)
        leaning = ((normal[:, :2, None] * along).sum(1) - facing * slant) * upright
        # Cosines to the view: of the tangent plane first, of the horizon then.
        low = leaning * -1 * torch.rsqrt(leaning * leaning + facing * facing)
        horizon = _stacked(low.unsqueeze(1))  # (N, 1, rays h, w)
        centre, eye = _repeated(here), torch.split(_repeated(view), 1, 1)
        told, towards, sideways, seen, close, sent = [], [], [], [], [], []
        before = horizon * 0
        for ring, light in zip(RINGS, lights, strict=True):
            there = _moved(torch.cat([here, normal, light], 1), ring)  # (N, 9, rays h, w)
            points, normals, light = torch.split(there, 3, 1)
            delta = torch.split(points + centre * -1, 1, 1)
            square = _total(d * d for d in delta).clamp(1e-8, 16)
            inverse = torch.rsqrt(square)
            distance = square * inverse
            # how much of the way from the ray's last point to this one lies within the radius
            near = ((before * -1 + 1) / (distance + before * -1).clamp_min(1e-3)).clamp(0, 1)
            near = near * (distance * -_FADE + _GONE * _FADE).clamp(0, 1)
            before = distance
            cosine = _total(d * e for d, e in zip(delta, eye, strict=True)) * inverse
            back = _total(d * n for d, n in zip(delta, torch.split(normals, 1, 1), strict=True))
            rise = F.relu(cosine.clamp(-1, 1) + horizon * -1)
            rise = (rise + rise.clamp(max=_STEP) * 0.5) * near  # up to half-way to the next point
            rise = torch.minimum(rise, 1 - horizon)
            turned = (back * inverse).clamp(-1, 1)  # < 0: what is seen of it faces the receiver
            told += [rise, cosine.clamp(-1, 1) * near, turned * near, distance * 0.25]
            above = horizon + rise
            towards.append(rise * (above + horizon) * 0.5)
            sideways.append(_arc(horizon, above) * rise)
            seen.append(rise)
            close.append(near)
            sent.append(light)
            horizon = above
        gains = torch.exp(self.ray(torch.cat(told, 1)).clamp(-_MOST, _MOST))
        sums = []
        for parts in (towards, sideways, seen):
            shares = torch.split(torch.cat(parts, 1) * gains, 1, 1)
            total = _total(part * s for part, s in zip(sent, shares, strict=True))
            sums.append(total.reshape(size))  # (N, 3, rays, h, w)
        # the mean light of all points within the radius, be they visible from here or not
        reached = _total(part * n for part, n in zip(sent, close, strict=True)).reshape(size)
        count = _total(close).reshape(size).sum(2)
        around = reached.sum(2) / count.clamp_min(1)
        share = 1 / len(RAYS)
        side = sums[1] * (upright * (2 * share)).unsqueeze(1)
        right, up = ((side * along[k]).sum(2) for k in (0, 1))
        x, y, z = torch.split(view, 1, 1)
        depth = sums[0].sum(2) * (2 * share) - right * x - up * y
        open_ = sums[2].sum(2) * share
        return torch.cat([right + depth * x, up + depth * y, depth * z, open_, around], 1)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        normal, cells = state
        wide = F.interpolate(cells, scale_factor=CELL, mode="bilinear", align_corners=False)
        x, y, z, seen, around = torch.split(wide, 3, 1)
        gain, bend, open_, hidden = torch.split(weights * _CAUTION, [1, 3, 1, 1], 1)
        i, j, k = torch.split(normal + bend, 1, 1)
        image = x * i + y * j + z * k + seen * open_
        return image * torch.exp(gain.clamp(-_MOST, _MOST)) + around * (hidden * _GUESS)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        # The two nearest cells, from which it is up-sampled, and those that fill a gap there.
        first = (pixel - CELL // 2) // CELL
        cells = grown((first, first + 1), 1)
        reach = max(r + _reach(s) for r, s in zip(RINGS, SPREADS, strict=True))
        return folded(grown(cells, reach), CELL)


def _reach(spread: int) -> int:
    """Cells that the light of a square of `spread` cells comes from, to one side."""
    return sum({s // 2 for s in SPREADS if s <= spread})


def _spread(pooled: Tensor) -> list[Tensor]:
    """Mean light (N, 3, h, w) of surfaces, a ring each, from its sum and their share (N, 4, h, w).

    One square is blurred after the other.
    """
    means: dict[int, Tensor] = {}
    for spread in sorted(set(SPREADS)):
        if spread > 1:
            half = spread // 2
            pooled = F.avg_pool2d(pooled, (1, spread), 1, (0, half))
            pooled = F.avg_pool2d(pooled, (spread, 1), 1, (half, 0))
        means[spread] = pooled[:, :3] / pooled[:, 3:].clamp_min(1e-9)
    return [means[spread] for spread in SPREADS]


def _arc(a: Tensor, b: Tensor) -> Tensor:
    """The mean of √(1 - c²) over cosines c from a to b, both in [-1, 1].

    Times b - a it is the integral, and exactly 0 where that is: engines round the difference of
    two integrals to something else, which any light from beyond the radius would be seen by.
    """
    first, second, both = a * a, b * b, a * b
    three = first + second + both
    five = first * first + second * second + both * three
    return five * _ARC[2] + three * _ARC[1] + _ARC[0]


def _total(parts: Iterable[Tensor]) -> Tensor:
    return reduce(add, parts)


def _stacked(x: Tensor) -> Tensor:
    """(N, C, rays, h, w) to (N, C, rays h, w): engines like four axes."""
    count, channels, rays, height, width = x.shape
    return x.reshape(count, channels, rays * height, width)


def _repeated(x: Tensor) -> Tensor:
    """(N, C, h, w) to (N, C, rays h, w): the same for each ray."""
    return torch.cat([x] * len(RAYS), 2)


def _moved(x: Tensor, ring: int) -> Tensor:
    """(N, C, h, w) to (N, C, rays h, w): what lies `ring` cells away; beyond the edge _AWAY."""
    wide = F.pad(x, (ring, ring, ring, ring), value=_AWAY)
    moved = []
    for right, up in RAYS:
        columns, rows = round(right * ring), round(-up * ring)
        cut = (-ring - columns, columns - ring, -ring - rows, rows - ring)
        moved.append(F.pad(wide, cut))
    return torch.cat(moved, 2)
