"""Indirect light: what the surfaces in the picture send, gathered along rays over the picture.

Around each cell of 4 x 4 pixels points are looked at in six directions, at distances that grow
geometrically; four neighbours take turns at both, so that the smoothing after it, along surfaces,
sees 24 directions. The sector that a point newly raises above the horizon so far it fills with its
light (B. Mayaux, *Horizon-Based Indirect Lighting*, 2018; slices through the view as in J. Jimenez,
X. Wu, A. Pesce and A. Jarabo, *Practical Real-Time Strategies for Accurate Indirect Occlusion*,
2016). A sector's ∫ ω dω has a closed form, so that a cell carries each colour's vector irradiance
(J. Arvo, *The Irradiance Jacobian for Partially Occluded Polyhedral Sources*, 1994). Every pixel
takes from the nearest cells that lie on its surface (J. Kopf, M. Cohen, D. Lischinski and
M. Uyttendaele, *Joint Bilateral Upsampling*, 2007), by its own normal.

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
from deepshade_trainer.networks.bases.cells import enlarged, smoothed
from deepshade_trainer.networks.horizons import covered, sampled, unit
from deepshade_trainer.networks.receptive_field import Span, folded, grown

CELL = 4
# Cells take turns, 2 x 2 of them: each has other directions and distances.
TURNS = 2
_PHASES = TURNS * TURNS
RAYS = 6  # from each cell
# How many cells away the points of a ray lie, and how many cells wide the square is whose mean
# light each of them sends. By turns they are nearer and farther, by up to a sixth.
RINGS = (2, 4, 6, 10, 16, 24, 34, 48, 70)
SPREADS = (1, 1, 1, 3, 5, 5, 9, 17, 17)
_FARTHER = (0.86, 1.05, 1.16, 0.95)
_ANGLES = [
    [2 * math.pi * (ray + turn / _PHASES) / RAYS for turn in (0, 2, 3, 1)] for ray in range(RAYS)
]
# Right and up in the picture, for each ray and turn.
DIRECTIONS = [[(math.cos(angle), math.sin(angle)) for angle in turns] for turns in _ANGLES]
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
# How far apart two angles' cosines may be, for the sine of what lies between them.
_CHORD = 1.2
_PLACES = [(ray, phase) for ray in range(RAYS) for phase in range(_PHASES)]


class Bounces(Bases):
    """Light of one bounce; input: normal (3), position (3, effect radii), diffuse light (3).

    The trunk's weights at a pixel: the logarithm of a gain; three numbers to add to its normal; a
    share of the light that its cell sees, from wherever; and a share of the mean light within the
    radius, for what the picture doesn't show. All zero is the horizons' answer.
    """

    told = 6  # normal and position as they are: a geometric trunk tells itself the horizons
    weights = 6
    size_multiple = CELL * TURNS
    along: Tensor

    def __init__(self) -> None:
        super().__init__()
        count = len(RINGS)
        last = nn.Conv2d(_HIDDEN, count, 1)
        nn.init.normal_(last.weight, std=1e-3)
        nn.init.zeros_(last.bias)  # type: ignore[arg-type]
        self.ray = nn.Sequential(nn.Conv2d(count * _TOLD, _HIDDEN, 1), nn.ReLU(), last)
        along = torch.tensor(DIRECTIONS, dtype=torch.float32).permute(2, 0, 1)
        along = along.reshape(2, RAYS, _PHASES, 1)
        self.register_buffer("along", along, persistent=False)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        normal, position, light = torch.split(gbuffer, 3, 1)
        surface = covered(position[:, 2:])
        pooled = F.avg_pool2d(torch.cat([light * surface, surface], 1), CELL)  # (N, 4, h, w)
        six = torch.cat([normal, position], 1)
        cells = sampled(six, CELL)
        directions, places = unit(cells[:, :3]), cells[:, 3:]
        carried = self._gathered(directions, places, _spread(pooled))
        normal = unit(normal)
        state = torch.cat([normal, position], 1), torch.cat([directions, places], 1)
        return six, (*state, smoothed(carried, directions, places))

    def _gathered(self, normal: Tensor, position: Tensor, lights: Sequence[Tensor]) -> Tensor:
        """What cells receive (N, 15, h, w) of the light of others (N, 3, h, w), at each ring.

        Of each colour: the vector irradiance's x, y and z over π, the light of all its sectors
        over 2 π, and the mean light within the radius.
        """
        count, _, height, width = position.shape
        height, width = height // TURNS, width // TURNS
        size = (count, -1, RAYS, _PHASES, height * width)
        across, depth = torch.split(position, [2, 1], 1)
        # Nothing is near what is far behind the camera: neither background nor what isn't there.
        here = torch.cat([across, depth + (covered(depth) * -_AWAY + _AWAY)], 1)
        surface = torch.cat([here, normal], 1)
        here, normal = torch.split(_by_turns(surface), 3, 1)  # (N, 3, turns h, w)
        view = unit(_by_turns(position) * -1)  # to the eye

        def lengthwise(vectors: Tensor) -> Tensor:
            """How far vectors (N, 3, turns h, w) go along each ray: (N, 1, rays turns h, w)."""
            flat = vectors[:, :2].reshape(count, 2, 1, _PHASES, height * width)
            return (flat * self.along).sum(1).reshape(count, 1, -1, width)

        # The ray's direction square to the view is (along - view · slant) · upright.
        slant = lengthwise(view)
        upright = torch.rsqrt((1 - slant * slant).clamp_min(1e-3))
        facing = _repeated((normal * view).sum(1, keepdim=True).clamp_min(0.02))
        leaning = (lengthwise(normal) - facing * slant) * upright
        # Cosines to the view: of the tangent plane first, of the horizon then.
        shortened = torch.rsqrt(leaning * leaning + facing * facing)
        tangent = horizon = leaning * -1 * shortened
        upward = torch.split(_repeated(normal) * (shortened * _CHORD), 1, 1)
        centre, eye = _repeated(here), torch.split(_repeated(view), 1, 1)
        told, towards, sideways, seen, close, sent = [], [], [], [], [], []
        before = horizon * 0
        for ring, light in zip(RINGS, lights, strict=True):
            there = _moved(torch.cat([surface, light], 1), ring)  # (N, 9, rays turns h, w)
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
            # Cells lie beside the ray; none may seem to rise above a tangent plane that it is on.
            above = _total(d * t for d, t in zip(delta, upward, strict=True)) * inverse
            cosine = torch.minimum(cosine, tangent + F.relu(above)).clamp(-1, 1)
            back = _total(d * n for d, n in zip(delta, torch.split(normals, 1, 1), strict=True))
            rise = F.relu(cosine + horizon * -1)
            rise = (rise + rise.clamp(max=_STEP) * 0.5) * near  # up to half-way to the next point
            rise = torch.minimum(rise, F.relu(1 - horizon))
            turned = (back * inverse).clamp(-1, 1)  # < 0: what is seen of it faces the receiver
            told += [rise, cosine * near, turned * near, distance * 0.25]
            above = horizon + rise
            towards.append(rise * (above + horizon) * 0.5)
            sideways.append(rise * _steepness(above, horizon))
            seen.append(rise)
            close.append(near)
            sent.append(light)
            horizon = above
        gains = torch.exp(self.ray(torch.cat(told, 1)).clamp(-_MOST, _MOST))
        gained = [s * g for s, g in zip(sent, torch.split(gains, 1, 1), strict=True)]
        sums = [
            _total(light * part for light, part in zip(gained, parts, strict=True)).reshape(size)
            for parts in (towards, sideways, seen)
        ]  # (N, 3, rays, h, w)
        # the mean light of all points within the radius, be they visible from here or not
        reached = _total(part * n for part, n in zip(sent, close, strict=True)).reshape(size)
        around = reached.sum(2) / _total(close).reshape(size).sum(2).clamp_min(1)
        share = 1 / RAYS
        side = (sums[1] * (upright * (2 * share)).reshape(size)).unsqueeze(1)
        # (N, 3, turns, h w)
        right, up = ((side * self.along[k : k + 1]).sum(3).squeeze(1) for k in (0, 1))
        x, y, z = torch.split(view.reshape(count, 3, _PHASES, -1), 1, 1)
        depth = sums[0].sum(2) * (2 * share) - right * x - up * y
        open_ = sums[2].sum(2) * share
        found = torch.cat([right + depth * x, up + depth * y, depth * z, open_, around], 1)
        return F.pixel_shuffle(found.reshape(count, -1, height, width), TURNS)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        pixels, surface, cells = state
        gain, bend, shares = torch.split(weights * _CAUTION, [1, 3, 2], 1)
        open_, hidden = torch.split(F.avg_pool2d(shares, CELL), 1, 1)
        *flow, seen, around = torch.split(cells, 3, 1)
        rest = seen * open_ + around * (hidden * _GUESS)
        carried = enlarged(torch.cat([*flow, rest], 1), surface, pixels, CELL)
        x, y, z, rest = torch.split(carried, 3, 1)
        i, j, k = torch.split(pixels[:, :3] + bend, 1, 1)
        return (x * i + y * j + z * k + rest) * torch.exp(gain.clamp(-_MOST, _MOST))

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        # The two nearest cells, from which it is up-sampled, and those they are smoothed with.
        first = (pixel - CELL // 2) // CELL
        cells = grown((first, first + 1), 1)
        reach = max(
            _reach(spread) + max(abs(n) for place in _PLACES for n in _offset(ring, *place))
            for ring, spread in zip(RINGS, SPREADS, strict=True)
        )
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


def _steepness(a: Tensor, b: Tensor) -> Tensor:
    """∫ √(1 - c²) dc from b to a over (a - b), for cosines in [-1, 1].

    A difference of two integrals wouldn't be exactly 0 where nothing rises, and light is large.
    """
    product = a * b
    square = a * a + b * b
    both = square + product
    return (square * both + product * product * -1) * _ARC[2] + both * _ARC[1] + _ARC[0]


def _total(parts: Iterable[Tensor]) -> Tensor:
    return reduce(add, parts)


def _by_turns(x: Tensor) -> Tensor:
    """(N, C, 2 h, 2 w) to (N, C, turns h, w): cells that have the same turn together."""
    count, channels, _, width = x.shape
    return F.pixel_unshuffle(x, TURNS).reshape(count, channels, -1, width // TURNS)


def _repeated(x: Tensor) -> Tensor:
    """(N, C, turns h, w) to (N, C, rays turns h, w): the same for each ray."""
    return torch.cat([x] * RAYS, 2)


def _offset(ring: int, ray: int, phase: int) -> tuple[int, int]:
    """Columns right and rows down, in cells, to a point of a ray."""
    right, up = DIRECTIONS[ray][phase]
    far = ring * _FARTHER[(phase + ray) % _PHASES]
    return round(right * far), round(-up * far)


def _moved(x: Tensor, ring: int) -> Tensor:
    """(N, C, 2 h, 2 w) to (N, C, rays turns h, w): a ring's points; beyond the edge _AWAY."""
    margin = max(abs(n) for k in _PLACES for n in _offset(ring, *k)) // TURNS + 1
    wide = F.pad(F.pixel_unshuffle(x, TURNS), (margin,) * 4, value=_AWAY)
    count, channels, height, width = wide.shape
    turns = wide.reshape(count, channels // _PHASES, _PHASES, height, width).unbind(2)
    moved = []
    for ray, phase in _PLACES:
        right, down = _offset(ring, ray, phase)
        rows, row = divmod(phase // TURNS + down, TURNS)
        columns, column = divmod(phase % TURNS + right, TURNS)
        cut = (-margin - columns, columns - margin, -margin - rows, rows - margin)
        moved.append(F.pad(turns[row * TURNS + column], cut))
    return torch.cat(moved, 2)
