"""Light spread over discs of a few sizes: what blur circles are blended from."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.receptive_field import Span, doubled, folded, grown, joined

# The discs' radii are 0 and 1 pixels at full resolution, 2, 4 and 8 at half, 16 and 24 at a
# quarter; a circle between two of them is shared out to both.
_FAINT = 1e-3  # what is hidden still counts where nothing else is there
_SURE = 4.0  # weights end at e^±4


class Discs(Bases):
    """Layers by the size of the blur circle and by side of the focus; input: focal (1), light (3).

    Each pixel is scattered over discs about its own circle's size, near and far side apart, with
    the share of the lens that it covers. The classical answer lays the near side over what is
    in focus and that over the far side (layered depth of field: Scofield, "2½-D Depth-of-Field
    Simulation for Computer Animation", 1992; near and far fields: Jimenez, "Next Generation Post
    Processing in Call of Duty: Advanced Warfare", 2014), each by its coverage, so that what was
    hidden is continued from around. Two weights change how much the near and the far side count.
    """

    told = 2
    weights = 2
    size_multiple = 4

    disc1: Tensor
    disc2: Tensor
    disc4: Tensor
    disc8: Tensor
    disc16: Tensor
    disc24: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("disc1", _discs(1, 4), persistent=False)
        self.register_buffer("disc2", _discs(2 / 2, 8), persistent=False)
        self.register_buffer("disc4", _discs(4 / 2, 8), persistent=False)
        self.register_buffer("disc8", _discs(8 / 2, 8), persistent=False)
        self.register_buffer("disc16", _discs(16 / 4, 8), persistent=False)
        self.register_buffer("disc24", _discs(24 / 4, 8), persistent=False)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        focal, light = torch.split(gbuffer, [1, 3], 1)
        radius = focal.abs() * 0.5
        lit = torch.cat([torch.ones_like(radius), light], 1)  # (N, 4, H, W), premultiplied below
        sharp = lit * (1 - radius).clamp(0, 1)
        one = _spread(lit * torch.minimum(radius, 2 - radius).clamp(0, 1), self.disc1)
        near, close = _side(lit, (focal * -0.5 - 1).clamp(0, 1), radius)
        far, distant = _side(lit, (focal * 0.5 - 1).clamp(0, 1), radius)

        def layer(low: float, middle: float, high: float) -> Tensor:
            hats = _hat(close, low, middle, high), _hat(distant, low, middle, high)
            return torch.cat([near * hats[0], far * hats[1]], 1)  # (N, 8, H / 2, W / 2)

        mild = _spread(layer(0, 2, 4), self.disc2) + _spread(layer(2, 4, 8), self.disc4)
        mild = mild + _spread(layer(4, 8, 16), self.disc8)
        strong = _spread(F.avg_pool2d(layer(8, 16, 24), 2), self.disc16)
        strong = strong + _spread(F.avg_pool2d(layer(16, 24, 0), 2), self.disc24)
        strong = _twice(strong)
        # The nearer lies over the farther: before the focus that is what is blurred more.
        over = strong[:, :4] + (1 - strong[:, :1].clamp(max=1)) * mild[:, :4]
        under = mild[:, 4:] + (1 - mild[:, 4:5].clamp(max=1)) * strong[:, 4:]
        layers = sharp, one, _twice(over), _twice(under)
        return torch.cat([focal / (focal.abs() + 4), layers[2][:, :1].clamp(max=2)], 1), layers

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        sharp, one, near, far = state
        gains = torch.split(torch.exp(torch.tanh(weights / _SURE) * _SURE), 1, 1)
        left = 1 - near[:, :1].clamp(max=1)
        behind = left * (1 - (sharp[:, :1] + one[:, :1]).clamp(max=1)) + _FAINT
        total = near * gains[0] + far * (behind * gains[1]) + (sharp + one) * (left + _FAINT)
        return total[:, 1:] / total[:, :1].clamp_min(1e-12)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        half = doubled((pixel, pixel))
        quarter = grown(doubled(half), self.disc24.shape[-1] // 2)
        wide = joined(grown(half, self.disc8.shape[-1] // 2), folded(quarter, 2))
        return joined(folded(wide, 2), grown((pixel, pixel), self.disc1.shape[-1] // 2))


def _side(lit: Tensor, share: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """One side of the focus at half resolution: premultiplied (N, 4, h, w), and its radius."""
    half = F.avg_pool2d(lit * share, 2)
    return half, F.avg_pool2d(radius * share, 2) / half[:, :1].clamp_min(1e-6)


def _hat(x: Tensor, low: float, middle: float, high: float) -> Tensor:
    """1 at `middle`, falling to 0 at `low` and at `high`; a 0 for one of these: 1 to that side."""
    rise, fall = (x - low) / (middle - low), (high - x) / (high - middle)
    return (rise if not high else fall if not low else torch.minimum(rise, fall)).clamp(0, 1)


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
    return F.interpolate(planes, scale_factor=2, mode="bilinear", align_corners=False)
