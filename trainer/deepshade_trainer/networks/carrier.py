"""Our network for effects that are linear in light: geometry decides weights, light is carried."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from deepshade.errors import ConfigError
from deepshade_trainer.networks.bases import BASES
from deepshade_trainer.networks.fold_unet import FoldConfig, FoldUNet
from deepshade_trainer.networks.network import Network, check_types, full_precision
from deepshade_trainer.networks.receptive_field import Span, folded, joined


@dataclass(frozen=True)
class CarrierConfig:
    """Which `bases` light is blended from, and the shape of the `FoldUNet` that weighs them.

    `inputs` are the channels of the G-buffer, all three colours of light among them.
    """

    kind: str = "carrier"
    inputs: int = 4
    outputs: int = 3
    bases: str = "neighbours"
    widths: tuple[int, ...] = (48, 96, 128)
    steps: tuple[int, ...] = (4, 2)
    down: tuple[int, ...] = (1, 2, 2)
    up: tuple[int, ...] = (2, 2)
    fold: int = 4
    normal: int | None = None
    position: int | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError where entries don't fit each other."""
        check_types(self)
        if self.bases not in BASES:
            raise ConfigError(self.bases, BASES, detail=f"no bases {self.bases!r}")

    @property
    def trunk(self) -> FoldConfig:
        """The network that predicts the weights."""
        bases = BASES[self.bases]
        shared: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("widths", "steps", "down", "up", "fold", "normal", "position")
        }
        return FoldConfig(inputs=bases.told, outputs=bases.weights, **shared)


class Carrier(Network):
    """Blends `bases` of the light by weights that a `FoldUNet` predicts.

    The weights begin near 0, where the bases' own, classical answer lies: only what that misses is
    learnt. Light takes no part in a convolution of the network and passes linearly, in float32, so
    any exposure comes out right. (Kernels and blend weights that a network predicts: Vogels et al.,
    "Denoising with Kernel Prediction and Asymmetric Loss Functions", 2018; Balint et al., "Neural
    Partitioning Pyramids for Denoising Monte Carlo Renderings", 2023.)
    """

    linear = True
    rounded = "trunk."

    def __init__(self, config: CarrierConfig) -> None:
        super().__init__()
        self.bases = BASES[config.bases]()
        self.trunk = FoldUNet(config.trunk)

    @property
    def size_multiple(self) -> int:
        """What both parts need."""
        return math.lcm(self.trunk.size_multiple * self.bases.cell, self.bases.size_multiple)

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        reach, cell = self.bases.reach, self.bases.cell
        cells = (
            self.trunk.receptive_field((pixel - reach) // cell)[0],
            self.trunk.receptive_field((pixel + reach) // cell)[1],
        )
        first, last = folded(cells, cell)
        wide = joined(self.bases.receptive_field(first), self.bases.receptive_field(last))
        return joined(wide, self.bases.receptive_field(pixel))

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`."""
        with full_precision():
            told, state = self.bases.features(gbuffer.float())
        weights = self.trunk(told)
        with full_precision():
            return self.bases.carry(state, weights.float())

    def prepare_export(self) -> None:
        """See `Network.prepare_export`."""
        self.trunk.prepare_export()
