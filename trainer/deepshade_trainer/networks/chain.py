"""A chain of convolutions at full resolution: the paper's networks for `aa` and `ibl`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError
from deepshade_trainer.networks.network import Network, check_types
from deepshade_trainer.networks.receptive_field import Span, grown


@dataclass(frozen=True)
class ChainConfig:
    """Convolutions of `kernel` x `kernel` with `widths` channels, and one to the outputs.

    The last has `groups` groups.
    """

    kind: str = "chain"
    inputs: int = 2
    outputs: int = 1
    widths: tuple[int, ...] = (16,)
    kernel: int = 5
    groups: int = 1

    def __post_init__(self) -> None:
        """Raise ConfigError for values that no network could mean."""
        check_types(self)
        if self.kernel % 2 == 0:
            raise ConfigError("kernel", detail="kernel must be odd")
        last = (self.inputs, *self.widths)[-1]
        if self.groups < 1 or last % self.groups or self.outputs % self.groups:
            raise ConfigError("groups", detail="groups must divide the last width and the outputs")


class Chain(Network):
    """Convolutions one after the other, each followed by LeakyReLU (paper, section 4.1)."""

    def __init__(self, config: ChainConfig) -> None:
        super().__init__()
        channels, k = (config.inputs, *config.widths, config.outputs), config.kernel
        groups = [*[1] * len(config.widths), config.groups]
        self.layers = nn.ModuleList(
            nn.Conv2d(a, b, k, padding=k // 2, groups=g)
            for (a, b), g in zip(itertools.pairwise(channels), groups, strict=True)
        )
        self.reach = len(self.layers) * (k // 2)

    @property
    def size_multiple(self) -> int:
        """Any size will do."""
        return 1

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        return grown((pixel, pixel), self.reach)

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`."""
        x = gbuffer
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.01)  # (N, width, H, W), at last (N, outputs, H, W)
        return x
