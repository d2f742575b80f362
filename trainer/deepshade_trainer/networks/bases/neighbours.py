"""Each pixel's neighbours: what edges are blended from."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.base import Bases, State
from deepshade_trainer.networks.receptive_field import Span, grown

# Rows down and columns right.
_AROUND = ((0, 1), (1, 0), (0, -1), (-1, 0))
_TINY = 1e-20  # of radiance: black is black
# Shares begin small: a network that says nothing leaves the picture almost as it is.
_START = -4.0


class Neighbours(Bases):
    """The pixel and its four neighbours; input: depth (1), light (3).

    A weight moves light from its neighbour: share_k = exp(weight_k) / (1 + Σ exp(weight)).
    (Blending with a neighbour is what morphological anti-aliasing does: Jimenez et al., "SMAA:
    Enhanced Subpixel Morphological Antialiasing", 2012.) The network is told edges: by how much
    light and nearness (1 / depth; 0 in background) change to the right and downwards,
    (a - b) / (a + b). So it sees neither exposure nor a scene's size, and a bright pixel only where
    it is.
    """

    told = 8
    weights = 4

    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """See `Bases.features`."""
        depth, light = torch.split(gbuffer, [1, 3], 1)
        near = (depth > 0) / (depth.abs() + _TINY)
        seen = torch.cat([light, near], 1)
        height, width = light.shape[2:]
        wide = F.pad(seen, (0, 1, 0, 1), mode="replicate")
        edges = [_step(seen, wide[:, :, :height, 1:]), _step(seen, wide[:, :, 1:, :width])]
        return torch.cat(edges, 1), (light,)

    def carry(self, state: State, weights: Tensor) -> Tensor:
        """See `Bases.carry`."""
        (light,) = state
        count, _, height, width = light.shape
        wide = F.pad(light, (1, 1, 1, 1), mode="replicate")
        image, total = light, torch.ones_like(light[:, :1])
        # As rows of pixels: an engine that holds a pixel's channels together then puts each plane
        # in one piece, all at once, where its split of channels is slow.
        shares = torch.split(torch.exp((weights + _START).clamp(max=12.0)).flatten(2), 1, 1)
        for (down, right), each in zip(_AROUND, shares, strict=True):
            rows, columns = slice(1 + down, 1 + down + height), slice(1 + right, 1 + right + width)
            share = each.reshape(count, 1, height, width)
            image = image + share * wide[:, :, rows, columns]
            total = total + share
        return image / total

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        return grown((pixel, pixel), 1)


def _step(here: Tensor, there: Tensor) -> Tensor:
    """How one changes to the other, in [-1, 1]; 0 where both are 0."""
    return (here - there) / (here.abs() + there.abs() + _TINY)
