"""Image-based light, dimmed by occlusion and seen through a lens: three shaders in one graph."""

from __future__ import annotations

import math

from torch import Tensor, nn

from deepshade.tensors import channel_slices
from deepshade_trainer.networks.bases.discs import Discs
from deepshade_trainer.networks.carrier import Carrier
from deepshade_trainer.networks.fold_unet import FoldUNet, full_precision
from deepshade_trainer.networks.horizons import covered
from deepshade_trainer.networks.receptive_field import Span, halo, joined
from deepshade_trainer.networks.reflections import ATTRIBUTES as SURFACE
from deepshade_trainer.networks.reflections import Reflections

# what a graph takes, in this order
ATTRIBUTES = (*SURFACE, "normal", "position", "focal")


class Lens(nn.Module):
    """A G-buffer (`ATTRIBUTES`), an environment's table and a turn to radiance through a thin lens.

    The light of `reflections`, weighted by `occlusion` (of normals and positions, 1 is open) where
    there is a surface, is blurred by `blur`, a `Carrier` of `Discs`. Both trunks see geometry
    alone, so that the answer is linear in the environment.
    """

    rounded = ("occlusion.", "blur.trunk.")

    def __init__(self, reflections: Reflections, occlusion: FoldUNet, blur: Carrier) -> None:
        super().__init__()
        self.reflections, self.occlusion, self.blur = reflections, occlusion, blur
        assert isinstance(blur.bases, Discs)
        self.discs: Discs = blur.bases
        self.places = channel_slices(ATTRIBUTES, False)

    @property
    def size_multiple(self) -> int:
        """What all parts need."""
        return math.lcm(self.occlusion.size_multiple, self.blur.size_multiple)

    @property
    def halo(self) -> int:
        """See `Network.halo`."""
        return halo(self.receptive_field, self.size_multiple)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`: the blur's own, and what dims the light it spreads."""
        first, last = self.discs.receptive_field(pixel)
        dimmed = self.occlusion.receptive_field(first)[0], self.occlusion.receptive_field(last)[1]
        return joined(self.blur.receptive_field(pixel), dimmed)

    def forward(self, gbuffer: Tensor, table: Tensor, turn: Tensor) -> Tensor:
        """(1, 20, H, W), (1, 3, HEIGHT, WIDTH) and (3, 3) to radiance (1, 3, H, W)."""
        position, focal = self.places["position"], self.places["focal"]
        openness = self.occlusion(gbuffer, self.places["normal"].start)
        with full_precision():
            surface = covered(gbuffer[:, position.stop - 1 : position.stop])
            openness = ((openness - 1) * surface + 1).clamp(0, 1)
            light = self.reflections(gbuffer, table, turn) * openness
            told, state = self.discs.spread(gbuffer[:, focal], light)
        weights = self.blur.trunk(told)
        with full_precision():
            seen: Tensor = self.discs.carry(state, weights.float()).clamp_min(0)
            return seen

    def prepare_export(self) -> None:
        """See `Network.prepare_export`."""
        self.occlusion.prepare_export()
        self.blur.prepare_export()
