"""The networks: the paper's U-Net and ours, each from a small config.

A `Shader` maps a G-buffer (N, C, H, W) as bundles define it (camera-space normals of any length,
camera-space positions divided by the effect radius, zeros where there is no geometry) to an image
(N, outputs, H, W). H and W are multiples of `size_multiple`. Nothing in it depends on the rest of
the image beyond `halo` pixels, so that tiles equal the whole.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# First and last of a run of pixels along one axis.
Span = tuple[int, int]


@dataclass(frozen=True)
class NetworkConfig:
    """What a network is made of.

    `kind` is "paper" or "fold". `widths` are the channels of each level, finest first; `fold`
    pixels along each side become channels at the door; `windows` are the sizes (pixels) of the
    blocks whose mean position each pixel is seen from; `depth` residual blocks a level and side.
    `normal` and `position` are the first of their three input channels, None without them.
    """

    kind: str = "fold"
    inputs: int = 6
    outputs: int = 1
    widths: tuple[int, ...] = (32, 48, 64, 96, 128)
    fold: int = 2
    windows: tuple[int, ...] = (4, 16, 64)
    depth: int = 1
    kernel: int = 3
    normal: int | None = 0
    position: int | None = 3


class Shader(nn.Module, ABC):
    """Base of all networks: finds the background and keeps it at `background`."""

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

    @abstractmethod
    def shade(self, gbuffer: Tensor, covered: Tensor) -> Tensor:
        """The network itself: (N, C, H, W) and coverage (N, 1, H, W) to (N, outputs, H, W)."""

    def forward(self, gbuffer: Tensor) -> Tensor:
        """Shade (N, C, H, W); unbounded while training, [0, 1] in evaluation mode."""
        # A background pixel has no normal; where there are no normals, it has nothing at all.
        start = self.config.normal
        told = gbuffer if start is None else gbuffer[:, start : start + 3]
        covered = (told.square().sum(1, keepdim=True) > 1e-12).to(gbuffer.dtype)
        image = self.shade(gbuffer, covered).float()
        if not self.training:
            image = image.clamp(0, 1)
        return image * covered + self.background * (1 - covered)


class PaperUNet(Shader):
    """The paper's network (section 4.1): grouped convolutions on raw normals and positions."""

    def __init__(self, config: NetworkConfig, background: float) -> None:
        super().__init__(config, background)
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
        return _through_u((pixel, pixel), len(self.config.widths), self.config.kernel // 2)

    def shade(self, gbuffer: Tensor, covered: Tensor) -> Tensor:
        """See `Shader.shade`."""
        x, skips = gbuffer, []
        for n, conv in enumerate(self.down):
            x = F.leaky_relu(conv(F.avg_pool2d(x, 2) if n else x), 0.01)
            skips.append(x)
        for n in reversed(range(len(self.up))):
            x = torch.cat([_double(x), skips[n]], 1)
            x = self.up[n](x)
            if n:
                x = F.leaky_relu(x, 0.01)
        return x


class FoldUNet(Shader):
    """Our network: features relative to local means, pixels folded into channels, dense 3 x 3.

    Large positions never enter a convolution. Each pixel sees the mean position of the blocks
    around it at several scales, relative to itself and in units of the effect radius, and how
    far that mean lies above its own tangent plane, which is what occludes it.
    """

    def __init__(self, config: NetworkConfig, background: float) -> None:
        super().__init__(config, background)
        widths, cells = config.widths, config.fold**2
        if config.normal is None or config.position is None:
            raise ValueError("the folded network needs normals and positions")
        self.other = [
            k
            for k in range(config.inputs)
            if not config.normal <= k < config.normal + 3
            and not config.position <= k < config.position + 3
        ]
        features = 5 + 4 * len(config.windows) + len(self.other)
        self.door = nn.Conv2d(features * cells, widths[0], 3, padding=1)
        self.encode = nn.ModuleList(_blocks(width, config.depth) for width in widths)
        self.shrink = nn.ModuleList(
            nn.Conv2d(a, b, 2, stride=2) for a, b in itertools.pairwise(widths)
        )
        self.grow = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in itertools.pairwise(widths))
        self.decode = nn.ModuleList(_blocks(width, config.depth) for width in widths[:-1])
        self.head = nn.Conv2d(widths[0], config.outputs * cells, 3, padding=1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, 0.85)  # type: ignore[arg-type]

    @property
    def size_multiple(self) -> int:
        """One pixel of the coarsest level, and whole blocks of every window."""
        coarsest = self.config.fold * 2 ** (len(self.config.widths) - 1)
        return math.lcm(coarsest, *self.config.windows)

    def needs(self, pixel: int) -> Span:
        """See `Shader.needs`."""
        fold = self.config.fold
        head = _grown((pixel // fold, pixel // fold), 1)
        door = _through_u(head, len(self.config.widths), 2 * self.config.depth)
        first, final = _folded(_grown(door, 1), fold)
        span = first, final
        for window in self.config.windows:  # the two nearest blocks of each pixel
            low = (first - window // 2) // window * window
            high = ((final - window // 2) // window + 2) * window - 1
            span = _joined(span, (low, high))
        return span

    def features(self, gbuffer: Tensor, covered: Tensor) -> Tensor:
        """(N, 5 + 4 windows + other inputs, H, W) for a G-buffer (N, inputs, H, W).

        Unit normal, R/z, coverage; per window offset and height; what else there is as it is.
        """
        start, place = self.config.normal or 0, self.config.position or 0
        normal, position = gbuffer[:, start : start + 3], gbuffer[:, place : place + 3]
        length = normal.square().sum(1, keepdim=True)
        normal = normal * torch.rsqrt(length.clamp_min(1e-12))
        nearness = covered / (-position[:, 2:3]).clamp_min(0.25)
        found = [normal, nearness, covered]
        weighted = torch.cat([position * covered, covered], 1)
        for window in self.config.windows:
            mean = F.avg_pool2d(weighted, window)
            mean = F.interpolate(mean, scale_factor=window, mode="bilinear", align_corners=False)
            offset = mean[:, :3] / mean[:, 3:].clamp_min(1e-4) - position
            # Softsign bounds what lies far behind an edge; the gain suits a window's own size.
            offset = F.softsign(offset * (8.0 / window**0.5)) * covered
            height = (offset * normal).sum(1, keepdim=True)
            found += [offset, height]
        if self.other:
            found.append(gbuffer[:, self.other])
        return torch.cat(found, 1)

    def shade(self, gbuffer: Tensor, covered: Tensor) -> Tensor:
        """See `Shader.shade`."""
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            x = F.pixel_unshuffle(self.features(gbuffer, covered), self.config.fold)
        x = self.door(x.contiguous(memory_format=torch.channels_last))
        skips = []
        for n, blocks in enumerate(self.encode):
            x = blocks(self.shrink[n - 1](x) if n else x)
            skips.append(x)
        for n in reversed(range(len(self.decode))):
            x = self.decode[n](skips[n] + _double(self.grow[n](x)))
        # bf16 has only 1/256 between 0.5 and 1, where most of an occlusion image lies.
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return F.pixel_shuffle(self.head(x.to(self.head.weight.dtype)), self.config.fold)


class Residual(nn.Module):
    """x + conv(relu(conv(relu(x))))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """(N, width, H, W) to the same."""
        y: Tensor = self.second(F.relu(self.first(F.relu(x))))
        return x + y


def _grown(span: Span, reach: int) -> Span:
    """What a convolution that reaches `reach` pixels needs."""
    return span[0] - reach, span[1] + reach


def _doubled(span: Span) -> Span:
    """What bilinear x 2 needs of the coarser level: the two nearest of each pixel."""
    return (span[0] - 1) // 2, (span[1] - 1) // 2 + 1


def _folded(span: Span, factor: int) -> Span:
    """What pooling or folding by `factor` needs of the finer level."""
    return span[0] * factor, span[1] * factor + factor - 1


def _joined(a: Span, b: Span) -> Span:
    return min(a[0], b[0]), max(a[1], b[1])


def _through_u(span: Span, levels: int, reach: int) -> Span:
    """What a U of `levels` needs, whose convolutions reach `reach` pixels a level and side."""
    skips = []
    for _ in range(levels - 1):
        span = _grown(span, reach)
        skips.append(span)
        span = _doubled(span)
    span = _grown(span, reach)
    for skip in reversed(skips):
        span = _grown(_joined(_folded(span, 2), skip), reach)
    return span


def _blocks(width: int, depth: int) -> nn.Sequential:
    return nn.Sequential(*(Residual(width) for _ in range(depth)))


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


KINDS: dict[str, type[Shader]] = {"paper": PaperUNet, "fold": FoldUNet}


def build(config: NetworkConfig, background: float = 1.0) -> Shader:
    """Make the network that `config` describes."""
    return KINDS[config.kind](config, background)
