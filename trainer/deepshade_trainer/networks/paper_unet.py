"""The paper's U-Net (section 4.1): grouped convolutions on raw attributes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError
from deepshade_trainer.networks.network import Network, check_types
from deepshade_trainer.networks.receptive_field import Span, doubled, folded, grown, joined


@dataclass(frozen=True)
class PaperConfig:
    """Level n, of `levels`, has `u0` * 2^n channels in 2^n groups; kernels are `kernel` wide."""

    kind: str = "paper"
    inputs: int = 6
    outputs: int = 1
    u0: int = 8
    levels: int = 6
    kernel: int = 3

    def __post_init__(self) -> None:
        """Raise ConfigError for values that no network could mean."""
        check_types(self)
        if self.levels < 1 or self.u0 < 1 or self.kernel % 2 == 0:
            raise ConfigError(
                "levels", detail="levels and u0 must be at least 1, and kernel must be odd"
            )


class PaperUNet(Network):
    """The paper's U-Net, as its authors published it.

    Each level has one convolution on the way down and one on the way up, which at level 0 gives
    the outputs; LeakyReLU stands after all of them, the outputs too. Their fixed 4 x 4
    deconvolution is bilinear x 2, but for the picture's edge, where it would let zeros in.
    """

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        widths = [config.u0 * 2**n for n in range(config.levels)]
        k, self.levels = config.kernel, config.levels
        self.reach = k // 2
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, k, padding=k // 2, groups=2**n)
            for n, (a, b) in enumerate(zip([config.inputs, *widths[:-1]], widths, strict=True))
        )
        self.up = nn.ModuleList(
            nn.Conv2d(widths[n + 1] + widths[n], b, k, padding=k // 2, groups=2**n)
            for n, b in enumerate([config.outputs, *widths[1:-1]][: config.levels - 1])
        )

    @property
    def size_multiple(self) -> int:
        """One pixel of the coarsest level."""
        return int(2 ** (self.levels - 1))

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        span, skips = (pixel, pixel), []
        for _ in self.up:
            span = grown(span, self.reach)
            skips.append(span)
            span = doubled(span)
        span = grown(span, self.reach)
        for skip in reversed(skips):
            span = grown(joined(folded(span, 2), skip), self.reach)
        return span

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Network.forward`."""
        x, skips = gbuffer, []
        for n, convolution in enumerate(self.down):
            x = F.avg_pool2d(x, 2) if n else x  # (N, u0 2^(n-1), H / 2^n, W / 2^n)
            x = F.leaky_relu(convolution(x), 0.01)  # (N, u0 2^n, H / 2^n, W / 2^n)
            skips.append(x)
        for n in reversed(range(len(self.up))):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = torch.cat([x, skips[n]], 1)  # (N, 3 u0 2^n, H / 2^n, W / 2^n)
            x = F.leaky_relu(self.up[n](x), 0.01)  # (N, u0 2^n, H / 2^n, W / 2^n)
        return x
