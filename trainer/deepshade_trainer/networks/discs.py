"""Light spread over discs of a few sizes, by the blur circle of each pixel: all is calculated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.enlarging import Twice
from deepshade_trainer.networks.network import Network, full_precision
from deepshade_trainer.networks.receptive_field import Span, doubled, folded, grown, joined

# Radii of blur in pixels at which light is spread at full resolution, at half and at a quarter of
# it: what lies between two of them is shared out to both.
_FULL = (0.0, 1.0, 2.0, 3.0, 4.0)
_HALF = (5.0, 7.0, 9.0)
_QUARTER = (12.0, 17.0, 24.0)
_COARSE = (*_HALF, *_QUARTER)
# Pooling and enlarging blur like a disc of about this radius, squared, at half and at a quarter.
_SOFT, _SOFTER = 16 / 3, 24.0
_APART = 1.0  # the radius from which on, to the next pixel, near surfaces lie over all others
_WIDE = 2.0  # that from which on, to twice that, they show what they hide
_HIDDEN = 10.0  # over about which radius what they hide is continued
_FAINT = 1e-4  # how much a sharp pixel counts in the blurred picture, so that it has no holes
_LEAST = 0.05  # how much of what is behind all is made up to a whole
_CLOSED = 1e-6  # how much shows through what covers all, so that nothing divides by 0


@dataclass(frozen=True)
class DiscsConfig:
    """There is nothing to choose."""

    kind: str = "discs"
    inputs: int = 4
    outputs: int = 3


class Discs(Network):
    """Layers by the size of the blur circle and by side of the focus; input: focal (1), light (3).

    Each pixel is scattered over discs about its own circle's size, near and far side apart, with
    the share of the lens that it covers. The answer lays the near side over what is in focus and
    that over the far side (layered depth of field: Scofield, "2½-D Depth-of-Field
    Simulation for Computer Animation", 1992; near and far fields: Jimenez, "Next Generation Post
    Processing in Call of Duty: Advanced Warfare", 2014), each by its coverage. What a near surface
    hides from the pinhole and shows through its edge is continued from around.

    Small circles are spread at full resolution, where what is in focus, or hardly before it, goes
    with the far side; large ones at half and less. Layers have eight channels: coverage and
    premultiplied light of the near side, then of the far one. Engines keep eight together, and
    fixed convolutions put values where they are needed sooner than splits would.
    """

    linear = True
    rounded = None
    calculated = True
    size_multiple = 4

    sides: Tensor
    least: Tensor
    far: Tensor
    before: Tensor
    behind: Tensor
    pooled_side: Tensor
    pooled_sides: Tensor
    pooled_light: Tensor
    pooled_coverage: Tensor
    pooled_first: Tensor
    over: Tensor
    hidden: Tensor

    def __init__(self, config: DiscsConfig | None = None) -> None:
        super().__init__()
        side = torch.eye(2).repeat_interleave(4, 0)  # (8, 2): which side a channel is of
        coverage = torch.tensor([1.0, 0, 0, 0]).repeat(2)  # (8,)
        light = torch.cat([torch.zeros(1, 3), torch.eye(3)]).repeat(2, 1)
        kernels = {
            "sides": torch.tensor([-0.5, 0.5])[None, :, None, None],
            "least": torch.tensor([0, _FAINT])[None, :, None, None],
            "far": side[:, 1][None, :, None, None],
            "before": side[:, 0],
            "behind": side[:, 1:, None, None],
            "pooled_side": _pooling(side),
            "pooled_sides": _pooling(torch.ones(8, 2)),
            "pooled_light": _pooling(light),
            "pooled_first": _pooling(coverage[:4, None]),
            "pooled_coverage": _pooling(coverage[:, None].repeat(1, 2)),
            "over": (side[:, 1:] * side[:, 1] * coverage)[:, :, None, None],
            "hidden": _discs(_HIDDEN / 4, 4),
        }
        for radii, soft, size in ((_FULL[1:], 0, 1), (_HALF, _SOFT, 2), (_QUARTER, _SOFTER, 4)):
            for radius in radii:
                kernels[f"disc{radius:g}"] = _discs(math.sqrt(radius**2 - soft) / size, 8)
        for name, kernel in kernels.items():
            self.register_buffer(name, kernel, persistent=False)
        self.twice, self.twice_four = Twice(8), Twice(4)

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`."""
        with full_precision():
            return self.spread(gbuffer[:, :1], gbuffer[:, 1:])

    def spread(self, focal: Tensor, light: Tensor) -> Tensor:
        """The answer (N, 3, H, W) to blur circles (N, 1, H, W) and light (N, 3, H, W)."""
        radius = focal.abs() * 0.5
        coarse = (radius - _FULL[-1]).clamp(0, 1)
        fine = self._fine(focal, radius, light, coarse)
        blurred = self.twice(self._blurred(focal, light, coarse))
        near, near_light, middle, middle_light = torch.split(fine, [1, 3, 1, 3], 1)
        more, more_light, far, far_light = torch.split(blurred, [1, 3, 1, 3], 1)
        near = near + more
        # What each leaves is for the next; what is last is made up to a whole.
        left = 1 - near.clamp(max=1)
        middles = left / middle.clamp_min(1)
        fars = left * (1 - middle.clamp(max=1)) / far.clamp_min(_LEAST)
        total = near_light + more_light + middles * middle_light + fars * far_light
        # nowhere 0: where nothing else is, there is what is faint
        return total / (near + middles * middle + fars * far)

    def _fine(self, focal: Tensor, radius: Tensor, light: Tensor, coarse: Tensor) -> Tensor:
        """Small circles, (N, 8, H, W). Of each pixel the share `coarse` isn't among them."""
        apart = (focal * -0.5 - _APART).clamp(0, 1)
        near, other = (1 - coarse) * apart, (1 - coarse) * (1 - apart)
        lit = torch.cat([near, near * light, other, other * light], 1)
        spread = torch.zeros(())
        for k, size in enumerate(_FULL[1:], 1):
            spread = spread + _spread(lit * _share(radius, _FULL, k), self._disc(size))
        # Nothing from behind spreads over what is sharp.
        over = F.conv2d((radius * 2).clamp(0, 1), self.behind, self.before)
        return lit * _share(radius, _FULL, 0) + spread * over

    def _blurred(self, focal: Tensor, light: Tensor, coarse: Tensor) -> Tensor:
        """Large circles, and what near surfaces hide, (N, 8, H / 2, W / 2)."""
        # (N, 1, 2, H, W), before and behind the focus: engines would pad 2 channels to 8
        radius = F.relu(focal[:, None] * self.sides[:, None])
        share = (radius - _FULL[-1]).clamp(0, 1) + self.least[:, None]
        share, outer = share.flatten(1, 2), (share * radius).flatten(1, 2)  # (N, 2, H, W)
        # All from here on is (N, 8, H / 2, W / 2). A cell's light is of both sides, where it has.
        cover = F.conv2d(share, self.pooled_side, stride=2)
        reach = F.conv2d(outer, self.pooled_side, stride=2) / cover.clamp_min(1e-6)
        lit = F.conv2d(light * (coarse + _FAINT), self.pooled_light, stride=2)
        lit = lit + F.conv2d(share, self.pooled_coverage, stride=2)
        lit = lit * (cover / F.conv2d(share, self.pooled_sides, stride=2))
        # Before the focus all adds up. Behind it, what is blurred less is nearer and lies over the
        # rest. Through what is sharp nothing shows, but through a wide near surface.
        wide = F.avg_pool2d((focal * (-0.5 / _WIDE) - 1).clamp(0, 1), 2)
        opening = 1 - self.far + self.far * (cover + wide)
        under, mild, layers, strong = opening, *(torch.zeros(()) for _ in range(3))
        for k, size in enumerate(_COARSE):
            layer, disc = lit * _share(reach, _COARSE, k), self._disc(size)
            if size in _QUARTER:
                strong = strong + _spread(F.avg_pool2d(layer, 2), disc)
                continue
            more = _spread(layer, disc)
            layers, mild = layers + more * under.clamp(_CLOSED, 1), mild + more
            under = opening - F.conv2d(mild, self.over)
        layers = layers + self.twice(strong) * under.clamp(_CLOSED, 1)
        # What a near surface hides.
        other = (1 + focal * (0.5 / _WIDE)).clamp(0, 1)
        other = F.conv2d(other, self.pooled_first, stride=2) + F.conv2d(
            other * light, self.pooled_light[:4], stride=2
        )
        hidden = self.twice_four(_spread(F.avg_pool2d(other, 2), self.hidden))
        seen = wide * (1 - layers[:, 4:5]).clamp_min(0)
        hidden = hidden * (seen / hidden[:, :1].clamp_min(1e-6))
        both: Tensor = layers + F.pad(hidden, (0, 0, 0, 0, 4, 0))
        return both

    def _disc(self, radius: float) -> Tensor:
        """The kernel of that radius, at the resolution where it spreads."""
        return self.get_buffer(f"disc{radius:g}")

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        full, mild, strong = (
            max(self._disc(radius).shape[-1] // 2 for radius in radii)
            for radii in (_FULL[1:], _HALF, _QUARTER)
        )
        half = doubled((pixel, pixel))
        wide = joined(grown(half, mild), folded(grown(doubled(half), strong), 2))
        return joined(folded(wide, 2), grown((pixel, pixel), full))


def _share(radius: Tensor, radii: tuple[float, ...], k: int) -> Tensor:
    """How much of what has this radius is spread by the k-th of `radii`."""
    sides = []
    if k:
        sides.append((radius - radii[k - 1]) / (radii[k] - radii[k - 1]))
    if k + 1 < len(radii):
        sides.append((radii[k + 1] - radius) / (radii[k + 1] - radii[k]))
    return (sides[0] if len(sides) == 1 else torch.minimum(*sides)).clamp(0, 1)


def _pooling(places: Tensor) -> Tensor:
    """(out, in, 2, 2) means of 2 x 2 pixels, put where `places` (out, in) says."""
    return places[:, :, None, None].repeat(1, 1, 2, 2) / 4


def _discs(radius: float, count: int) -> Tensor:
    """(count, 1, size, size) shares of a disc in each pixel, by 16 x 16 samples; they sum to 1."""
    size = 2 * math.ceil(radius - 0.5) + 1
    place = (torch.arange(size * 16) + 0.5) / 16 - size / 2
    inside = (place[:, None] ** 2 + place[None] ** 2 <= radius**2).float()
    shares = F.avg_pool2d(inside[None, None], 16)
    return (shares / shares.sum()).repeat(count, 1, 1, 1)


def _spread(planes: Tensor, discs: Tensor) -> Tensor:
    """Each plane convolved with its disc; nothing lies beyond the picture."""
    return F.conv2d(planes, discs, padding=discs.shape[-1] // 2, groups=discs.shape[0])
