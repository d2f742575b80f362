"""The networks: the paper's U-Net and ours, each from a small config.

A `Shader` maps a G-buffer (N, C, H, W) as bundles define it (camera-space normals of any length,
camera-space positions divided by the effect radius, zeros where there is no geometry) to an image
(N, outputs, H, W). H and W are multiples of `size_multiple`. Nothing in it depends on the rest of
the image beyond `halo` pixels, so that tiles equal the whole.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn

from deepshade_trainer.networks.receptive_field import Span

KINDS = ("fold", "paper")


@dataclass(frozen=True)
class NetworkConfig:
    """What a network is made of.

    `kind` is "paper" or "fold". `widths` are the channels of each level, finest first. The paper's
    has convolutions of `kernel` x `kernel`. Ours folds `fold` x `fold` pixels into channels, its
    levels are `steps` times coarser than the one before, and have `down` convolutions of 3 x 3 on
    the way down and `up` on the way up. Every level is told its `horizons`, found `rings` cells
    away, the first `fine_rings`, and also those of its cells' quarters, `detail` quarters away,
    unless that is empty. `normal` and `position` are the first of their three input channels, None
    without them.
    """

    kind: str = "fold"
    inputs: int = 6
    outputs: int = 1
    widths: tuple[int, ...] = (48, 96, 128)
    steps: tuple[int, ...] = (4, 2)
    down: tuple[int, ...] = (1, 2, 2)
    up: tuple[int, ...] = (2, 2)
    fold: int = 4
    rings: tuple[int, ...] = (1, 1, 2, 2, 4, 4)
    fine_rings: tuple[int, ...] = (1, 1, 2, 3, 5, 8)
    detail: tuple[int, ...] = (1, 1)
    kernel: int = 3
    normal: int | None = 0
    position: int | None = 3


class Shader(nn.Module, ABC):
    """Base of all networks. Called, it gives [0, 1] in evaluation mode, unbounded in training."""

    def __init__(self, config: NetworkConfig, background: float) -> None:
        super().__init__()
        self.config = config
        self.background = background

    @property
    @abstractmethod
    def size_multiple(self) -> int:
        """Height and width must be multiples of this many pixels."""

    @abstractmethod
    def needs(self, pixel: int) -> Span:
        """The input columns that the output column `pixel` depends on (rows are alike)."""

    @property
    def halo(self) -> int:
        """How many pixels away an input may change an output, at most: exact, by construction."""
        reach = 0
        for pixel in range(self.size_multiple):
            first, last = self.needs(pixel)
            reach = max(reach, pixel - first, last - pixel)
        return reach

    @property
    def background_halo(self) -> int:
        """How many pixels of background around all geometry the answer may depend on, at most."""
        return self.halo

    @abstractmethod
    def forward(self, gbuffer: Tensor) -> Tensor:
        """(N, C, H, W) to (N, outputs, H, W) float32, `background` where there is no geometry."""


def build(config: NetworkConfig, background: float = 1.0) -> Shader:
    """Make the network that `config` describes.

    Raises:
        ConfigError: its entries don't fit each other.
    """
    from deepshade_trainer.networks.fold_unet import FoldUNet
    from deepshade_trainer.networks.paper_unet import PaperUNet

    return {"fold": FoldUNet, "paper": PaperUNet}[config.kind](config, background)
