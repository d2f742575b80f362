"""3 x 3 convolutions one after the other."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Stack(nn.ModuleList):
    """`count` convolutions without biases, each followed by ReLU; kept at zero where `mask` is.

    They begin as the identity plus noise, as residual ones do, at no cost. Masking before every
    second one is enough that what leaks out of a cell with geometry comes back only through cells
    next to one.
    """

    def __init__(self, width: int, count: int) -> None:
        super().__init__(nn.Conv2d(width, width, 3, padding=1, bias=False) for _ in range(count))
        for weight in self.parameters():
            nn.init.dirac_(weight)
            with torch.no_grad():
                weight.add_(torch.randn_like(weight), alpha=0.3 * (2 / (9 * width)) ** 0.5)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(N, width, H, W) to the same; `mask` (N, 1, H, W)."""
        for k, convolution in enumerate(self):
            if mask is not None and k % 2 == 0:
                x = x * mask.to(x.dtype)
            x = F.relu(convolution(x))
        return x
