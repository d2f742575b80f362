"""Image-based light, dimmed by occlusion and seen through a lens: three shaders in one graph."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from torch import Tensor

from deepshade.tensors import channel_slices
from deepshade_trainer.networks.discs import Discs
from deepshade_trainer.networks.fold_unet import FoldConfig, FoldUNet
from deepshade_trainer.networks.horizons import covered
from deepshade_trainer.networks.network import Network, full_precision
from deepshade_trainer.networks.receptive_field import Span, joined
from deepshade_trainer.networks.reflections import ATTRIBUTES as SURFACE
from deepshade_trainer.networks.reflections import Reflections

# what a graph takes, in this order
ATTRIBUTES = (*SURFACE, "normal", "position", "focal")


@dataclass(frozen=True)
class LensConfig:
    """The shape of what occludes, and the short hash of the bundle that its weights are `of`."""

    kind: str = "lens"
    inputs: int = 20
    outputs: int = 3
    occlusion: FoldConfig = field(default_factory=FoldConfig)
    of: str = ""


class Lens(Network):
    """A G-buffer (`ATTRIBUTES`), an environment's table and a turn to radiance through a thin lens.

    The light of `Reflections`, weighted by `occlusion` (of normals and positions, 1 is open) where
    there is a surface, is blurred by `Discs`. What occludes sees geometry alone, so that the
    answer is linear in the environment.
    """

    linear = True
    rounded = "occlusion."
    calculated = True
    environment = Reflections.environment

    def __init__(self, config: LensConfig) -> None:
        super().__init__()
        self.reflections, self.discs = Reflections(), Discs()
        self.occlusion = FoldUNet(config.occlusion)
        self.places = channel_slices(ATTRIBUTES, False)

    @property
    def size_multiple(self) -> int:
        """What all parts need."""
        return math.lcm(self.occlusion.size_multiple, self.discs.size_multiple)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`: the blur's own, and what dims the light it spreads."""
        first, last = self.discs.receptive_field(pixel)
        dimmed = self.occlusion.receptive_field(first)[0], self.occlusion.receptive_field(last)[1]
        return joined((first, last), dimmed)

    def forward(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(1, 20, H, W), (1, 3, HEIGHT, WIDTH) and (3, 3) to radiance (1, 3, H, W)."""
        position, focal = self.places["position"], self.places["focal"]
        openness = self.occlusion(gbuffer, self.places["normal"].start)
        with full_precision():
            surface = covered(gbuffer[:, position.stop - 1 : position.stop])
            openness = ((openness - 1) * surface + 1).clamp(0, 1)
            light = self.reflections(gbuffer, *given) * openness
            return self.discs.spread(gbuffer[:, focal], light)

    def prepare_export(self) -> None:
        """See `Network.prepare_export`."""
        self.occlusion.prepare_export()
