"""Each pixel's neighbours: what edges are blended from."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.receptive_field import Span, grown, joined

# Rows down and columns right.
_AROUND = ((0, 1), (1, 0), (0, -1), (-1, 0))
_BLOCK = 8  # pixels whose mean light is the unit that light is seen in
_TINY = 1e-20  # of radiance: black is black
# Shares begin small: a network that says nothing leaves the picture almost as it is.
_START = -5.0


class Neighbours(Bases):
    """The pixel and its four neighbours; input: depth (1), light (3).

    A weight moves light from its neighbour: share_k = exp(weight_k) / (1 + Σ exp(weight)).
    (Blending with a neighbour is what morphological anti-aliasing does: Jimenez et al., "SMAA:
    Enhanced Subpixel Morphological Antialiasing", 2012.) The network is told light relative to that
    of the block of pixels, and the nearness.
    """

    told = 4
    weights = 4
    size_multiple = _BLOCK

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        depth, light = torch.split(gbuffer, [1, 3], 1)
        count, _, height, width = light.shape
        level = F.avg_pool2d(light, _BLOCK).mean(1, keepdim=True)  # (N, 1, H / 8, W / 8)
        level = level[..., None, :, None] + _TINY
        blocks = light.reshape(count, 3, height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
        seen = (blocks / (blocks + level)).reshape(light.shape)  # in [0, 1], 1/2 for the level
        near = (depth > 0) / (1 + depth)  # of the median depth; background is 0
        return torch.cat([seen, near], 1), (light,)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        (light,) = state
        height, width = light.shape[2:]
        wide = F.pad(light, (1, 1, 1, 1), mode="replicate")
        image, total = light, torch.ones_like(light[:, :1])
        shares = torch.split(torch.exp((weights + _START).clamp(max=12.0)), 1, 1)
        for (down, right), share in zip(_AROUND, shares, strict=True):
            rows, columns = slice(1 + down, 1 + down + height), slice(1 + right, 1 + right + width)
            image = image + share * wide[:, :, rows, columns]
            total = total + share
        return image / total

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        block = pixel // _BLOCK * _BLOCK
        return joined(grown((pixel, pixel), 1), (block, block + _BLOCK - 1))
