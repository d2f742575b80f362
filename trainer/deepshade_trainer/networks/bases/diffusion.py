"""Subsurface scattering as a sum of Gaussians in space, each on its own level of a pyramid.

Burley's profile, R(r) = (e^(-r/d) + e^(-r/3d)) / (8 pi d r) (P. Christensen and B. Burley,
*Approximate Reflectance Profiles for Efficient Subsurface Scattering*, 2015, equation 2), is a
mixture of Gaussians: with e^(-r/d) / r = 2/sqrt(pi) * integral of exp(-r^2 t^2 - 1/(4 d^2 t^2)) dt,
t = 1/(sqrt(2) s), and one sample of s an octave, the mass of the Gaussian of deviation s is

    C s/d (exp(-s^2/2d^2) + exp(-s^2/18d^2)),

which sums to 1 within 0.2 %. Sums of Gaussians for skin: E. d'Eon and D. Luebke, GPU Gems 3 (2007),
chapter 14; here any mean free path has its own.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.enlarging import Twice
from deepshade_trainer.networks.horizons import covered
from deepshade_trainer.networks.network import constant
from deepshade_trainer.networks.receptive_field import Span, doubled, folded, grown, joined

# Levels of the pyramid: cells are 2^level pixels wide.
_LEVELS = 7
# The Gaussians' deviation in cells, all told; pooling and interpolating do _SPREAD of its square.
_SIGMA, _SPREAD = 1.0, 0.3
_FINEST = 0.8  # the finest Gaussian's, in pixels
# The coarsest level also makes the Gaussian an octave wider, from more of its cells.
_REACH = 2
# The mass of all Gaussians narrower than 1 is about (1 + ax + bx^2) / (1 + cx + ex^2 + gx^3),
# x = d, within 0.014: a least-squares fit.
_TOP, _BOTTOM = (8.2926, 85.373), (8.9354, 53.337, 296.64)
_FOLD = 4
_STEEPEST = 8.0
_FARTHEST = 256.0  # mean free paths are cut there, in deviations of the finest Gaussian
_SLACK = 8.0  # how many cells apart in depth are still one surface
_GUIDE = 4.0  # how far off a cell still lends its Gaussians, in its own widths
_AWAY, _TINY = 1e9, 1e-9
_ANGLE = 1 / 500  # of a pixel, where nothing tells


class Diffusion(Bases):
    """Light that scatters below surfaces, by Burley's profile: see above.

    Reads position (3), scatter (3, the mean free paths in the same unit) and light (3). A cell of
    level l holds the light and the area that its pixels have, and gathers those of its neighbours
    by their distance in space. A pixel adds the levels up by its own mean free path, light and area
    alike, and divides. What is finer than a pixel stays with the pixel.

    The trunk corrects the logarithms of the Gaussians' masses: one plane for the finest, at full
    resolution, and two that are folded to a weight for each of the others and each channel.
    """

    told = 8
    weights = 3
    size_multiple = 2**_LEVELS
    reach = 8

    def __init__(self) -> None:
        super().__init__()
        self.twice, self.twice_three = Twice(6), Twice(3)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        position, scatter, light = torch.split(gbuffer, 3, 1)
        cover = covered(position[:, 2:])
        scatters = (scatter * 1e12).clamp(0, 1) * cover  # (N, 3, H, W)
        both = torch.cat([scatters * light, scatters], 1)
        near = _blurred(both)

        # Half resolution, then coarser: mean positions of what scatters, its light and area.
        there = scatters.amax(1, keepdim=True)
        pooled = F.avg_pool2d(torch.cat([position * there, there, both], 1), 2)
        place, some, both = torch.split(pooled, [3, 1, 6], 1)
        place = place / some.clamp_min(0.25)
        some = (some * 4).clamp(0, 1)
        angle = _pixel_angle(place, some)  # (N, 1, H / 128, W / 128)
        sizes = [_repeated(angle, 2 ** (_LEVELS - level)) for level in range(_LEVELS + 1)]
        size = place[:, 2:] * -sizes[1] + _TINY
        slope = _slope(place, some, size)
        cells = torch.cat([place, some, slope, both * (slope * size * size * 4)], 1)
        levels: list[Tensor] = []  # where cells are, and how large
        sums: list[Tensor] = []  # light and area of each Gaussian, 6 channels
        for level in range(1, _LEVELS + 1):
            if level > 1:
                cells = _coarser(cells, sizes[level] * 2 ** (level - 1))
            place, some, slope, both = torch.split(cells, [3, 1, 1, 6], 1)
            size = place[:, 2:] * -sizes[level] + _TINY
            levels.append(torch.cat([place, size], 1))
            for octave in (0, 1) if level == _LEVELS else (0,):
                sigma = math.sqrt((_SIGMA * 2**octave) ** 2 - _SPREAD)
                around = _gathered(place, both, size, sigma, 2**level, _REACH if octave else 1)
                # where cells are too long for the Gaussian, sampling alone would add to its mass
                long = (slope * (0.4 / sigma)).clamp_min(1)
                sums.append(around * (some / (size * size * long)))

        # All wide Gaussians, at a quarter of the resolution.
        wide = torch.cat(sums[_LEVELS - 1 :], 1)
        for level in range(_LEVELS - 1, 1, -1):
            wide = _guided(wide, levels[level], levels[level - 1], _GUIDE * 2**level)
            wide = torch.cat([sums[level - 1], wide], 1)

        size = position[:, 2:] * -sizes[0] + _TINY
        path = scatter / size * (1 / _SIGMA) * scatters
        path = path.clamp(0, _FARTHEST)  # mean free path in deviations of the finest Gaussian
        half = F.avg_pool2d(torch.cat([path, scatters], 1), 2)
        relief = (position[:, 2:] - _repeated(levels[1][:, 2:3], 4)) / size
        relief = torch.tanh(relief * 0.1) * cover
        told = torch.cat([torch.log2(path + 0.05) * (0.25 * scatters), scatters, cover, relief], 1)
        return told, (light, path, scatters, near, half, sums[0], wide)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        light, path, scatters, near, half, middle, wide = state
        weights = torch.tanh(weights * 0.5) * 2
        fine, rest = torch.split(weights, [1, 2], 1)
        gains = torch.exp(F.pixel_unshuffle(rest, _FOLD))  # (N, 32, H / 4, W / 4)
        levels = torch.split(gains, 4, 1)

        paths, some = torch.split(half, 3, 1)
        paths = paths / some.clamp_min(0.25)
        total = middle * _pair(
            (_finer(paths * 0.25) - _finer(paths * 0.5)) * self.twice_three(_gain(levels[0]))
        )
        quarter, some = torch.split(F.avg_pool2d(half, 2), 3, 1)
        quarter = quarter / some.clamp_min(0.0625)
        finer = [_finer(quarter * 0.5**level) for level in range(2, _LEVELS + 3)]
        parts = [
            part * _pair(F.relu(more - less) * _gain(gain))
            for part, (less, more), gain in zip(
                torch.split(wide, 6, 1), itertools.pairwise(finer), levels[1:], strict=True
            )
        ]
        total = self.twice(total + self.twice(torch.stack(parts).sum(0)))

        own = _finer(path)
        finest = (_finer(path * 0.5) - own) * torch.exp(fine)
        near_lit, near_area = torch.split(near, 3, 1)
        lit, area = torch.split(total, 3, 1)
        lit = own * light + scatters * (finest * near_lit + lit)
        return lit / (own + scatters * (finest * near_area + area))

    def receptive_field(self, pixel: int) -> Span:
        """See `Bases.receptive_field`."""
        span = doubled((pixel, pixel))
        pixels = grown((pixel, pixel), 1)
        for level in range(1, _LEVELS + 1):
            cells = grown(span, _REACH if level == _LEVELS else 1)
            # the slopes look at one more cell of half the resolution
            pixels = joined(pixels, grown(folded(cells, 2**level), 2))
            span = doubled(span)
        # the angle of a pixel is a mean over the widest cells, and looks one farther
        whole = pixels[0] // self.size_multiple, pixels[1] // self.size_multiple
        return grown(folded(whole, self.size_multiple), 2)


def _finer(path: Tensor) -> Tensor:
    """The mass of all Gaussians narrower than 1, for mean free paths `path`, in 0...1."""
    (a, b), (c, e, g) = _TOP, _BOTTOM
    return ((path * b + a) * path + 1) / (((path * g + e) * path + c) * path + 1)


def _gathered(
    place: Tensor, both: Tensor, size: Tensor, sigma: float, cell: int, reach: int
) -> Tensor:
    """The sums of `both` (N, 6, h, w) over the cells up to `reach` away, by a Gaussian in space.

    `place` (N, 3, h, w), `size` of a pixel there (N, 1, h, w), `sigma` in cells of `cell` pixels.
    """
    together = F.pad(torch.cat([place, both], 1), (reach,) * 4)
    falloff = (size * size).reciprocal() * (-0.5 / (sigma * cell) ** 2)
    total = both
    steps = range(-reach, reach + 1)
    for down, right in itertools.product(steps, steps):
        if down or right:
            there, theirs = torch.split(_cut(together, reach, down, right), [3, 6], 1)
            total = total + theirs * torch.exp(_square(there - place) * falloff)
    return total * (1 / (2 * math.pi * (sigma * cell) ** 2))


def _coarser(cells: Tensor, size: Tensor) -> Tensor:
    """Cells (N, 11, h, w) of `_gathered` to (N, 11, h/2, w/2): of four, those near the nearest.

    A mean of both sides of an edge would lie in the air. `size` is that of a fine cell at distance
    1, (N, 1, h/2, w/2).
    """
    height, width = cells.shape[2:]
    rows = cells.reshape(cells.shape[0], 11, height // 2, 2, width // 2, 2)
    four = [rows[:, :, :, j, :, i] for j, i in itertools.product((0, 1), (0, 1))]
    depth = [one[:, 2:3] + (one[:, 3:4] - 1) * _AWAY for one in four]  # negative
    front = torch.maximum(torch.maximum(depth[0], depth[1]), torch.maximum(depth[2], depth[3]))
    scale = (front * size).abs().clamp_min(_TINY).reciprocal() * (1 / _SLACK)
    kept = [
        torch.exp(((z - front) * scale).clamp(-8, 0).square() * -0.5) * one[:, 3:4]
        for z, one in zip(depth, four, strict=True)
    ]
    share = kept[0] + kept[1] + kept[2] + kept[3]
    total = torch.stack([one * w for one, w in zip(four, kept, strict=True)]).sum(0)
    place, _, slope, both = torch.split(total, [3, 1, 1, 6], 1)
    inverse = share.clamp_min(1e-6).reciprocal()
    some = (share * 1e3).clamp(0, 1)
    # an area is per cell: these are sums
    return torch.cat([place * inverse, some, slope * inverse, both], 1)


def _guided(wide: Tensor, coarse: Tensor, fine: Tensor, cell: float) -> Tensor:
    """`wide` (N, C, h, w) at twice the resolution: from the nearest four of its cells, by distance.

    Of `coarse` (N, 4, h, w) and `fine` (N, 4, 2h, 2w) cells, positions and sizes of pixels.
    """
    place, size = torch.split(fine, [3, 1], 1)
    falloff = (size * size).reciprocal() * (-0.5 / cell**2)
    margin = F.pad(torch.cat([coarse[:, :3], wide], 1), (1, 1, 1, 1), mode="replicate")
    # the four phases of a cell's quarters each have the same four neighbours
    height, width = wide.shape[2:]
    phases = []
    quarters = torch.cat([place, falloff], 1).reshape(-1, 4, height, 2, width, 2)
    for j, i in itertools.product((0, 1), (0, 1)):
        here, fall = torch.split(quarters[:, :, :, j, :, i], [3, 1], 1)
        total = weight = None
        for down, right in itertools.product((0, 2 * j - 1), (0, 2 * i - 1)):
            there, theirs = torch.split(_cut(margin, 1, down, right), [3, wide.shape[1]], 1)
            share = (0.25 if down else 0.75) * (0.25 if right else 0.75)
            close = torch.exp(_square(there - here) * fall) * share
            total = theirs * close if total is None else total + theirs * close
            weight = close if weight is None else weight + close
        assert total is not None and weight is not None
        phases.append(total / (weight + 1e-4))
    rows = torch.stack([torch.stack(phases[:2], -1), torch.stack(phases[2:], -1)], 3)
    return rows.reshape(-1, wide.shape[1], 2 * height, 2 * width)


def _pixel_angle(place: Tensor, some: Tensor) -> Tensor:
    """The width of a pixel at distance 1, from positions (N, 3, h, w): (N, 1, h/64, w/64).

    From one column to the next, x/z changes by the same amount wherever there is surface. A mean
    over many does rounded positions no harm.
    """
    across = place[:, :1] / (place[:, 2:] * -1).clamp_min(1e-6)
    one = torch.cat([across, some], 1)
    other, known = torch.split(F.pad(one, (-1, 1, 0, 0)), 1, 1)
    known = known * some
    step = F.avg_pool2d(torch.cat([(other - across) * known, known], 1), 2 ** (_LEVELS - 1))
    total, share = torch.split(step, 1, 1)
    found = (share * 1e6).clamp(0, 1)
    return (total / share.clamp_min(1e-6)).clamp(1e-6, 1) * 0.5 * found + (1 - found) * _ANGLE


def _slope(place: Tensor, some: Tensor, size: Tensor) -> Tensor:
    """The area of the surface over that of the pixels, 1 to `_STEEPEST`: (N, 1, h, w).

    From differences of depth to the neighbour that is nearer in depth, the one before or after:
    the other may lie beyond an edge.
    """
    depth = place[:, 2:] * -1
    one = torch.cat([depth, some], 1)
    inverse = (size * 2).reciprocal()
    rises = []
    for pad in ((1, -1, 0, 0), (-1, 1, 0, 0)), ((0, 0, 1, -1), (0, 0, -1, 1)):
        before, seen = torch.split(F.pad(one, pad[0]), 1, 1)
        after, found = torch.split(F.pad(one, pad[1]), 1, 1)
        before, after = depth - before, after - depth
        first, second = before.abs() + (1 - seen) * _AWAY, after.abs() + (1 - found) * _AWAY
        nearer = torch.where(first < second, before, after)
        rise = nearer * inverse * torch.maximum(seen, found)
        rises.append(rise.clamp(-_STEEPEST, _STEEPEST))
    x, y = rises[0], rises[1] * -1
    across = place[:, :2] / depth.clamp_min(1e-6)
    along = x * across[:, :1] + y * across[:, 1:] + 1
    return (x * x + y * y + along * along).sqrt().clamp(1, _STEEPEST)


def _blurred(both: Tensor) -> Tensor:
    """(N, 6, H, W) by a Gaussian of deviation `_FINEST`, cut at 3 x 3."""
    side = _FINEST**2 / 2
    line = constant((side, 1 - 2 * side, side), both)
    kernel = (line[:, None] * line).expand(6, 1, 3, 3)
    return F.conv2d(both, kernel, padding=1, groups=6)


def _gain(four: Tensor) -> Tensor:
    """One shared by the channels and one for each: (N, 4, h, w) to (N, 3, h, w)."""
    shared, each = torch.split(four, [1, 3], 1)
    return shared * each


def _pair(mass: Tensor) -> Tensor:
    """For light and for area alike."""
    return torch.cat([mass, mass], 1)


def _square(vector: Tensor) -> Tensor:
    """(N, 3, h, w) to (N, 1, h, w): squared length."""
    x, y, z = torch.split(vector, 1, 1)
    return x * x + y * y + z * z


def _cut(wide: Tensor, margin: int, down: int, right: int) -> Tensor:
    """`wide` without its margin, moved."""
    return F.pad(wide, (-margin - right, right - margin, -margin - down, down - margin))


def _repeated(x: Tensor, times: int) -> Tensor:
    """Each value `times` x `times`."""
    return x if times == 1 else F.interpolate(x, scale_factor=float(times), mode="nearest")
