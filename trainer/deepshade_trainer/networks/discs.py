"""Light spread over discs of a few sizes, by the blur circle of each pixel: all is calculated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.network import Network, full_precision
from deepshade_trainer.networks.receptive_field import Span, doubled, folded, grown, joined

# Radii of blur in pixels: what lies between two of them is shared out to both. Below the first
# pixels are partly sharp. Those up to _HALF are spread at half resolution, others at a quarter.
_RADII = (2.0, 3.0, 5.0, 9.0, 16.0, 24.0)
_HALF = 5.0
# Pooling and enlarging blur like a disc of about this radius, squared, at half and at a quarter.
_SOFT, _SOFTER = 16 / 3, 24.0
_HIDDEN = 10.0  # over about which radius what a near surface hides is continued
_FAINT = 1e-4  # how much a sharp pixel counts in the blurred picture, so that it has no holes
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

    What is blurred is composited at half resolution and enlarged once. Its eight channels are
    coverage and premultiplied light of the near side, then of the far side: engines keep eight
    together, and fixed convolutions put values where they are needed sooner than splits would.
    """

    linear = True
    rounded = None
    calculated = True
    size_multiple = 4

    sides: Tensor
    least: Tensor
    side: Tensor
    both: Tensor
    light: Tensor
    one: Tensor
    first: Tensor
    over: Tensor
    open: Tensor
    before: Tensor
    far: Tensor
    hidden: Tensor

    def __init__(self, config: DiscsConfig | None = None) -> None:
        super().__init__()
        side = torch.eye(2).repeat_interleave(4, 0)  # (8, 2): which side a channel is of
        coverage = torch.tensor([1.0, 0, 0, 0]).repeat(2)  # (8,)
        light = torch.cat([torch.zeros(1, 3), torch.eye(3)]).repeat(2, 1)
        kernels = {
            "sides": torch.tensor([-0.5, 0.5])[None, :, None, None],
            "least": torch.tensor([0, _FAINT])[None, :, None, None],
            "side": _pooling(side),
            "both": _pooling(torch.ones(8, 2)),
            "light": _pooling(light),
            "one": _pooling(coverage[:, None].repeat(1, 2)),
            "first": coverage[None, :, None, None],
            "over": (side[:, 1:] * side[:, 1] * coverage)[:, :, None, None],
            "open": (side[:, 1:] * coverage)[:, :, None, None],
            "before": side[:, 0],
            "far": side[:, 1][None, :, None, None],
        }
        kernels["hidden"] = _discs(_HIDDEN / 4, 4)
        for radius in _RADII[1:]:
            soft, size = (_SOFT, 2) if radius <= _HALF else (_SOFTER, 4)
            kernels[f"disc{radius:g}"] = _discs(math.sqrt(radius**2 - soft) / size, 8)
        for name, kernel in kernels.items():
            self.register_buffer(name, kernel, persistent=False)

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`."""
        with full_precision():
            return self.spread(gbuffer[:, :1], gbuffer[:, 1:])

    def spread(self, focal: Tensor, light: Tensor) -> Tensor:
        """The answer (N, 3, H, W) to blur circles (N, 1, H, W) and light (N, 3, H, W)."""
        # (N, 1, 2, H, W), before and behind the focus: engines would pad 2 channels to 8
        radius = F.relu(focal[:, None] * self.sides[:, None])
        share = (radius / _RADII[0]).clamp(max=1) + self.least[:, None]
        share, outer = share.flatten(1, 2), (share * radius).flatten(1, 2)  # (N, 2, H, W)
        blurred = focal.abs() * (0.5 / _RADII[0])
        # All from here on is (N, 8, H / 2, W / 2). A cell's light is of both sides, where it has.
        cover = F.conv2d(share, self.side, stride=2)
        reach = F.conv2d(outer, self.side, stride=2) / cover.clamp_min(1e-6)
        lit = F.conv2d(light * (blurred.clamp(max=1) + _FAINT), self.light, stride=2)
        lit = lit + F.conv2d(share, self.one, stride=2)
        lit = lit * (cover / F.conv2d(share, self.both, stride=2))

        def layer(k: int) -> Tensor:
            """What has a circle of about the k-th radius."""
            here, rise, fall = _RADII[k], torch.ones(()), torch.ones(())
            if k:
                rise = (reach - _RADII[k - 1]) / (here - _RADII[k - 1])
            if k + 1 < len(_RADII):
                fall = (_RADII[k + 1] - reach) / (_RADII[k + 1] - here)
            return lit * torch.minimum(rise, fall).clamp(0, 1)

        mild, strong = layer(0), torch.zeros(())
        # Before the focus all adds up. Behind it, what is blurred less is nearer and lies over the
        # rest: what is sharp over all, the least blurred over what is two radii on.
        # Through what reaches into the focus nothing shows, but through a wide near surface.
        wide = torch.maximum((reach / _RADII[0] - 1).clamp(0, 1), self.far) * cover
        opening = F.conv2d(wide, self.open, self.before)
        layers, under = mild * opening, opening - F.conv2d(mild, self.over)
        for k, size in enumerate(_RADII[1:], 1):
            spread = getattr(self, f"disc{size:g}")
            if size > _HALF:
                strong = strong + _spread(F.avg_pool2d(layer(k), 2), spread)
                continue
            more = _spread(layer(k), spread)
            layers = layers + more * (opening if k == 1 else under.clamp(_CLOSED, 1))
            mild = mild + more
        under = opening - F.conv2d(mild, self.over)
        layers = layers + _twice(strong) * under.clamp(_CLOSED, 1)
        # What a near surface hides.
        other = light * (1 + focal * (0.5 / _RADII[0])).clamp(0, 1)
        other = F.conv2d(other, self.light, stride=2) + (1 - cover) * self.first
        hidden = _twice(_spread(F.avg_pool2d(other, 2)[:, :4], self.hidden))
        seen = wide[:, :1] * (1 - layers[:, 4:5]).clamp_min(0)
        hidden = hidden * (seen / hidden[:, :1].clamp_min(1e-6))
        near, far = torch.split(layers, 4, 1)
        left = 1 - near[:, :1].clamp(max=1)
        total = near + (far + hidden) * left
        left, total, colour = torch.split(_twice(torch.cat([left, total], 1)), [1, 1, 3], 1)
        # nowhere 0: where nothing else is, there is what is faint
        sharp = (1 - blurred).clamp_min(0) * left
        # Not as a difference: beside a light of 1e5 nothing would be left of what is dark.
        return colour / total * (1 - sharp) + light * sharp

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        half = doubled((pixel, pixel))
        mild, strong = (
            max(
                self.get_buffer(f"disc{r:g}").shape[-1] // 2 for r in _RADII[1:] if (r > _HALF) == s
            )
            for s in (False, True)
        )
        quarter = grown(doubled(half), strong)
        wide = joined(grown(half, mild), folded(quarter, 2))
        return joined(folded(wide, 2), (pixel, pixel))


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


def _twice(planes: Tensor) -> Tensor:
    """Bilinear (N, C, 2 H, 2 W). Engines are quicker at it when each plane is a picture."""
    count, channels, height, width = planes.shape
    alone = planes.reshape(-1, 1, height, width)
    twice = F.interpolate(alone, scale_factor=2, mode="bilinear", align_corners=False)
    return twice.reshape(count, channels, 2 * height, 2 * width)
