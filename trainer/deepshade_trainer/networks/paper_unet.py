"""The paper's network (section 4.1): grouped convolutions on raw normals and positions."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError
from deepshade_trainer.networks import NetworkConfig, Shader
from deepshade_trainer.networks.receptive_field import Span, through_u


class PaperUNet(Shader):
    """The paper's network (section 4.1): grouped convolutions on raw normals and positions."""

    def __init__(self, config: NetworkConfig, background: float) -> None:
        super().__init__(config, background)
        if not config.widths:
            raise ConfigError("widths", detail="the paper's network needs at least one width")
        widths, k = config.widths, config.kernel
        before = (config.inputs, *widths[:-1])
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, k, padding=k // 2, groups=2**n)
            for n, (a, b) in enumerate(zip(before, widths, strict=True))
        )
        after = (config.outputs, *widths[1:-1])
        self.up = nn.ModuleList(
            nn.Conv2d(widths[n + 1] + widths[n], out, k, padding=k // 2, groups=2**n)
            for n, out in enumerate(after)
        )

    @property
    def size_multiple(self) -> int:
        """One pixel of the coarsest level."""
        return int(2 ** (len(self.config.widths) - 1))

    def needs(self, pixel: int) -> Span:
        """See `Shader.needs`."""
        return through_u((pixel, pixel), len(self.config.widths), self.config.kernel // 2)

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Shader.forward`."""
        x, skips = gbuffer, []
        for n, conv in enumerate(self.down):
            x = F.leaky_relu(conv(F.avg_pool2d(x, 2) if n else x), 0.01)
            skips.append(x)
        for n in reversed(range(len(self.up))):
            x = torch.cat([_double(x), skips[n]], 1)
            x = self.up[n](x)
            if n:
                x = F.leaky_relu(x, 0.01)
        # A background pixel has no normal; where there are no normals, it has nothing at all.
        start = self.config.normal
        told = gbuffer if start is None else gbuffer[:, start : start + 3]
        covered = (told.square().sum(1, keepdim=True) > 1e-12).float()
        image = x.float() if self.training else x.float().clamp(0, 1)
        return image * covered + self.background * (1 - covered)


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
