"""Our network: pixels folded into channels, dense convolutions, geometry at every scale."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError

from .networks import NetworkConfig, Shader
from .spans import Span, folded, grown, joined

# Levels whose cells are this many pixels wide keep those without geometry at zero.
_MASKED = 16
# Neighbours (rows down, columns right), nearest first.
_AROUND = [(0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)]


class FoldUNet(Shader):
    """Our network: pixels folded into channels, dense convolutions, geometry at every scale.

    `fold` x `fold` pixels become one cell: their normals, their depths relative to the cell's mean,
    their coverage. At every coarser level each cell is told how far the cells around it rise above
    its own tangent plane, and how near they are, in units of the effect radius: what occludes it.
    All of that is float32 arithmetic before the first convolution, so that engines can run the
    convolutions in 16 or 8 bits while no large position ever matters to one.

    Nothing has a bias where there is no geometry, and coarse cells without geometry are kept at
    zero: to the pixels around it background is the same as the edge of the picture.
    """

    def __init__(self, config: NetworkConfig, background: float) -> None:
        super().__init__(config, background)
        widths, cells = config.widths, config.fold**2
        if config.normal is None or config.position is None:
            raise ConfigError("kind", detail="the folded network needs normals and positions")
        levels = len(config.widths)
        if (len(config.down), len(config.up), len(config.steps)) != (
            levels,
            levels - 1,
            levels - 1,
        ):
            raise ConfigError(
                "widths",
                detail="down needs an entry for each of the widths, up and steps one fewer",
            )
        if self._sizes[min(1, levels - 1)] % config.sample:
            raise ConfigError("sample", detail="sample must divide the second level's cells")
        place = config.position
        # Raw positions are too large for a convolution in 16 bits; everything else is welcome.
        self.raw = [k for k in range(config.inputs) if not place <= k < place + 3]
        self.door = nn.Conv2d(len(self.raw), widths[0], config.fold, stride=config.fold, bias=False)
        self.relief = nn.Conv2d(cells, widths[0], 1, bias=False)
        pairs = list(zip(itertools.pairwise(widths), config.steps, strict=True))
        self.tell = nn.ModuleList(
            nn.Conv2d(5 + 2 * config.around, width, 1, bias=False) for width in widths[1:]
        )
        self.encode = nn.ModuleList(map(_stack, widths, config.down))
        self.shrink = nn.ModuleList(
            nn.Conv2d(fine, coarse, step, stride=step, bias=False) for (fine, coarse), step in pairs
        )
        self.grow = nn.ModuleList(
            nn.ConvTranspose2d(coarse, fine, step, stride=step, bias=False)
            for (fine, coarse), step in pairs
        )
        self.decode = nn.ModuleList(map(_stack, widths[:-1], config.up))
        self.head = nn.Conv2d(widths[0], config.outputs * cells, 3, padding=1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, 0.85)  # type: ignore[arg-type]

    @property
    def size_multiple(self) -> int:
        """One cell of the coarsest level, and whole samples of the second."""
        return math.lcm(self._sizes[-1], self.config.sample)

    @property
    def _sizes(self) -> list[int]:
        """Pixels along a cell's side, at each level."""
        return list(itertools.accumulate(self.config.steps, operator.mul, initial=self.config.fold))

    @property
    def background_halo(self) -> int:
        """See `Shader.background_halo`.

        What leaks into background at the unmasked levels must get out and back to matter; there
        it goes no further than their convolutions reach.
        """
        config, leak = self.config, self.config.fold
        for size, down, up in zip(self._sizes, config.down, (*config.up, 0), strict=True):
            leak += size * (down + up) if size < _MASKED else 0
        return math.ceil(leak / 2 / self.size_multiple) * self.size_multiple

    def needs(self, pixel: int) -> Span:
        """See `Shader.needs`."""
        config = self.config
        span = grown((pixel // config.fold, pixel // config.fold), 1)
        skips = []
        for step, count in zip(config.steps, config.up, strict=True):
            span = grown(span, count)
            skips.append(span)
            span = span[0] // step, span[1] // step
        pixels = (pixel, pixel)
        middle = config.sample // 2
        for n in reversed(range(len(config.widths))):
            if n < len(skips):
                span = joined(folded(span, config.steps[n]), skips[n])
            span = grown(span, config.down[n])
            if n:  # what its cells are told is seen through their neighbours' samples
                first, last = folded(grown(span, 1), self._sizes[n])
                pixels = joined(pixels, (first + middle, last + 1 - config.sample + middle))
        return joined(pixels, folded(span, config.fold))

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Shader.forward`."""
        with _full_precision():
            relief, covered, told, masks = self.features(gbuffer)
        # Cutting the positions out would cost more than multiplying them by zero.
        place, weight = self.config.position or 0, self.door.weight
        blank = torch.zeros_like(weight[:, :1]).expand(-1, 3, -1, -1)
        weight = torch.cat([weight[:, :place], blank, weight[:, place:]], 1)
        x = F.conv2d(gbuffer, weight, stride=self.config.fold)
        x = F.relu(x + self.relief(relief))
        skips = []
        for n, stack in enumerate(self.encode):
            if n:
                x = F.relu(self.shrink[n - 1](x) + self.tell[n - 1](told[n - 1]))
            x = stack(x, masks[n])
            skips.append(x)
        for n in reversed(range(len(self.decode))):
            x = F.relu(skips[n] + self.grow[n](x))
            x = self.decode[n](x, masks[n])
        # bf16 has only 1/256 between 0.5 and 1, where most of an occlusion image lies.
        with _full_precision():
            image = self.head(x.to(self.head.weight.dtype)).float()
            if not self.training:
                image = image.clamp(0, 1)
            covered = covered.repeat(1, self.config.outputs, 1, 1)
            image = (image - self.background) * covered + self.background
            return F.pixel_shuffle(image, self.config.fold)

    def features(self, gbuffer: Tensor) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor | None]]:
        """What the positions of a G-buffer (N, inputs, H, W) tell, all in float32.

        Returns each pixel's depth relative to its cell's mean, and its coverage, both
        (N, fold², h, w); for each level but the first what its cells are told
        (N, 5 + 2 around, ...); and for each level its mask of cells with geometry, or None.
        """
        config = self.config
        start, place = config.normal or 0, config.position or 0
        depth = gbuffer[:, place + 2 : place + 3]
        depth = space_to_depth(depth, config.fold)
        # 1 where there is geometry: nearer than 1e-4 radii nothing can be.
        present = (depth * -1e4).clamp(0, 1)
        count = present.sum(1, keepdim=True)
        # Added, not subtracted: some engines rewrite subtractions in lower precision.
        mean = depth.sum(1, keepdim=True) * (1 / count.clamp_min(1))
        # From 0 (far nearer than the mean) to 2 (far behind it); 0 as well where there is nothing.
        relief = (depth * -4 + (mean * 4 + count.clamp(0, 1))).clamp(0, 2)
        # Few pixels stand for their cells: the mean of all would cost as much as the rest.
        six = gbuffer
        if (start, place, gbuffer.shape[1]) != (0, 3, 6):
            six = torch.cat([gbuffer[:, start : start + 3], gbuffer[:, place : place + 3]], 1)
        seen = _sampled(six, config.sample)
        cells = F.avg_pool2d(count * config.fold**-2.0, self._sizes[1] // config.fold)
        near = torch.cat([seen, (seen[:, 5:6] * -1e4).clamp(0, 1)], 1)
        told: list[Tensor] = []
        masks: list[Tensor | None] = [None]
        size = config.sample
        for n, coarser in enumerate(self._sizes[1:], 1):
            if coarser > size:
                near = F.avg_pool2d(near, coarser // size)
                size = coarser
            if n > 1:
                cells = F.avg_pool2d(cells, config.steps[n - 1])
            told.append(self._tell(near, cells))
            masks.append((cells * 1e6).clamp(0, 1) if coarser >= _MASKED else None)
        return relief, present, told, masks

    def _tell(self, samples: Tensor, covered: Tensor) -> Tensor:
        """(N, 5 + 2 around, h, w): normal, R/z, coverage; each neighbour's rise and nearness."""
        normal = samples[:, :3]
        normal = normal * torch.rsqrt(normal.square().sum(1, keepdim=True) + 1e-12)
        here = samples[:, 3:7] * (1 / samples[:, 6:7].clamp_min(1e-4))  # mean position, and 1 or 0
        mask = here[:, 3:]
        nearness = mask * (1 / (here[:, 2:3] * -1).clamp_min(0.25))
        height, width = here.shape[2:]
        wide = F.pad(here, (1, 1, 1, 1))
        around = _AROUND[: self.config.around]
        there = [wide[:, :, 1 + r : 1 + r + height, 1 + c : 1 + c + width] for r, c in around]
        x, y, z = (
            torch.cat([t[:, k : k + 1] for t in there], 1) + here[:, k : k + 1] * -1
            for k in range(3)
        )
        square = x * x + y * y + z * z
        near = torch.cat([t[:, 3:] for t in there], 1) * mask * (1 / (1 + square * 2))
        rise = x * normal[:, :1] + y * normal[:, 1:2] + z * normal[:, 2:]
        rise = rise * torch.rsqrt(square + 1e-6) * near
        return torch.cat([normal, nearness, covered, rise, near], 1)


class Stack(nn.ModuleList):
    """3 x 3 convolutions without biases, each followed by ReLU; kept at zero where `mask` is.

    Masking before every second one is enough that what leaks out of a cell with geometry comes
    back only through cells next to one.
    """

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """(N, C, H, W) to the same; `mask` (N, 1, H, W)."""
        for k, convolution in enumerate(self):
            if mask is not None and k % 2 == 0:
                x = x * mask.to(x.dtype)
            x = F.relu(convolution(x))
        return x


def _stack(width: int, count: int) -> Stack:
    """Convolutions that begin as the identity plus noise, as residual ones do, at no cost."""
    stack = Stack(nn.Conv2d(width, width, 3, padding=1, bias=False) for _ in range(count))
    for weight in stack.parameters():
        nn.init.dirac_(weight)
        with torch.no_grad():
            weight.add_(torch.randn_like(weight), alpha=0.3 * (2 / (9 * width)) ** 0.5)
    return stack


class _SpaceToDepth(torch.autograd.Function):
    """Exports as ONNX's SpaceToDepth, which engines run fast, as they don't the transposition."""

    @staticmethod
    def symbolic(g: Any, x: Any, size: int) -> Any:
        return g.op("SpaceToDepth", x, blocksize_i=size)

    @staticmethod
    def forward(ctx: Any, x: Tensor, size: int) -> Tensor:
        return _space_to_depth(x, size)


def _space_to_depth(x: Tensor, size: int) -> Tensor:
    n, c, h, w = x.shape
    blocks = x.reshape(n, c, h // size, size, w // size, size).permute(0, 3, 5, 1, 2, 4)
    return blocks.reshape(n, c * size**2, h // size, w // size)


def space_to_depth(x: Tensor, size: int) -> Tensor:
    """(N, C, H, W) to (N, size² C, H/size, W/size), a pixel's channels together."""
    if torch.onnx.is_in_onnx_export():
        return _SpaceToDepth.apply(x, size)  # type: ignore[no-any-return,no-untyped-call]
    return _space_to_depth(x, size)


def _sampled(x: Tensor, size: int) -> Tensor:
    """(N, C, H/size, W/size): the middle pixel of each block; rows first, which is fastest."""
    n, c, h, w = x.shape
    x = x.reshape(n, c, h // size, size, w)[:, :, :, size // 2]
    return x.reshape(n, c, h // size, w // size, size)[:, :, :, :, size // 2]


@contextmanager
def _full_precision() -> Iterator[None]:
    """No automatic 16-bit arithmetic inside."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
