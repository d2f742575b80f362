"""Our network: pixels folded into channels, dense convolutions, geometry at every scale."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError
from deepshade_trainer.networks import NetworkConfig, Shader
from deepshade_trainer.networks.horizons import directions, horizons, sampled, unit
from deepshade_trainer.networks.receptive_field import Span, folded, grown, joined

# Levels whose cells are this many pixels wide keep those without geometry at zero.
_MASKED = 16
# What a coarse cell is told besides its horizons: normal, R/z, coverage.
_TOLD = 5


class FoldUNet(Shader):
    """Our network: pixels folded into channels, dense convolutions, geometry at every scale.

    The normals of `fold` x `fold` pixels become one cell. At every level each cell is told its
    `horizons`: what occludes it; with `detail`, the finest also those of its four quarters, for
    what is thinner than a cell. They are float32 arithmetic before the first convolution, so that
    engines can run the convolutions in 16 or 8 bits while no large position ever matters to one.

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
        for name in ("rings", "fine_rings"):
            if not (rings := getattr(config, name)) or min(rings) < 1:
                raise ConfigError(name, detail=f"{name} are distances of 1 cell or more")
        if config.detail and (min(config.detail) < 1 or config.fold % 2):
            raise ConfigError(
                "detail", detail="detail are distances of 1 quarter or more, and need an even fold"
            )
        place = config.position
        # Raw positions are too large for a convolution in 16 bits; everything else is welcome.
        self.raw = [k for k in range(config.inputs) if not place <= k < place + 3]
        self.door = nn.Conv2d(len(self.raw), widths[0], config.fold, stride=config.fold, bias=False)
        pairs = list(zip(itertools.pairwise(widths), config.steps, strict=True))
        self.horizon = nn.Conv2d(directions(config.fine_rings), widths[0], 1, bias=False)
        self.detail: nn.Conv2d | None = None
        if config.detail:
            self.detail = nn.Conv2d(directions(config.detail), widths[0], 2, stride=2, bias=False)
            # small, so that a network trained without it can go on with it
            nn.init.normal_(self.detail.weight, std=0.01)
        told = _TOLD + directions(config.rings)
        self.tell = nn.ModuleList(nn.Conv2d(told, width, 1, bias=False) for width in widths[1:])
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
        """One cell of the coarsest level."""
        return self._sizes[-1]

    @property
    def _sizes(self) -> list[int]:
        """Pixels along a cell's side, at each level."""
        return list(itertools.accumulate(self.config.steps, operator.mul, initial=self.config.fold))

    @property
    def background_halo(self) -> int:
        """See `Shader.background_halo`.

        What leaks into background must get out and back to matter. Unmasked levels let it go as far
        as their convolutions reach; the finest masked level that convolves on the way up, as far
        as those after its last mask: two cells if their number is even, else one.
        """
        config = self.config
        levels = list(zip(self._sizes, config.down, (*config.up, 0), strict=True))
        masked = [n > 0 and size >= _MASKED for n, size in enumerate(self._sizes)]
        leak = config.fold
        leak += sum(
            size * (down + up)
            for (size, down, up), quiet in zip(levels, masked, strict=True)
            if not quiet
        )
        for n, (size, down, up) in enumerate(levels):
            if not masked[n]:
                continue
            last = n + 1 == len(levels)
            if count := down if last else up:
                leak += size * (2 - count % 2)
                break
            leak += size if last else 0
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
        for n in reversed(range(len(config.widths))):
            if n < len(skips):
                span = joined(folded(span, config.steps[n]), skips[n])
            span = grown(span, config.down[n])
            size = self._sizes[n]
            first, last = grown(span, max(config.rings if n else config.fine_rings))
            pixels = joined(pixels, (self._sampled_at(first, size), self._sampled_at(last, size)))
        if config.detail:
            half = grown(folded(span, 2), max(config.detail))
            pixels = joined(pixels, (half[0] * config.fold // 2, half[1] * config.fold // 2))
        return joined(pixels, folded(span, config.fold))

    def _sampled_at(self, cell: int, size: int) -> int:
        """The pixel that stands for a cell of `size` pixels: see `features`."""
        fold = self.config.fold
        return cell * size + size // fold // 2 * fold + fold // 2

    def forward(self, gbuffer: Tensor) -> Tensor:
        """See `Shader.forward`."""
        with _full_precision():
            near, nearest, told, masks = self.features(gbuffer)
        place, weight = self.config.position or 0, self.door.weight
        if place + 3 == gbuffer.shape[1]:
            # All that is raw comes first. An odd number of channels would be slower in 16 bits.
            raw = gbuffer[:, : place + place % 2]
            weight = torch.cat([weight, torch.zeros_like(weight[:, : place % 2])], 1)
        else:
            raw = torch.cat([gbuffer[:, :place], gbuffer[:, place + 3 :]], 1)
        x = F.conv2d(raw, weight, stride=self.config.fold)
        x = x + self.horizon(near)
        if self.detail is not None:
            x = x + self.detail(nearest)
        x = F.relu(x)
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
            image = F.pixel_shuffle(image, self.config.fold)
            covered = _covered(gbuffer[:, place + 2 : place + 3])
            return (image - self.background) * covered + self.background

    def features(
        self, gbuffer: Tensor
    ) -> tuple[Tensor, Tensor | None, list[Tensor], list[Tensor | None]]:
        """What the positions of a G-buffer (N, inputs, H, W) tell, all in float32.

        Returns the first level's horizons (N, `directions`, h, w); those of its cells' quarters
        (N, `directions`, 2h, 2w), or None without `detail`; for each level but the first what its
        cells are told; and for each level its mask of cells with geometry, or None.
        """
        config = self.config
        start, place = config.normal or 0, config.position or 0
        six = gbuffer
        if (start, place, gbuffer.shape[1]) != (0, 3, 6):
            six = torch.cat([gbuffer[:, start : start + 3], gbuffer[:, place : place + 3]], 1)
        # One pixel stands for its cell. A mean would lie in the air where a cell shows an edge.
        nearest = None
        if config.detail:
            quarters = _seen(sampled(six, config.fold // 2, 0))
            nearest = horizons(quarters, config.detail)
            seen = sampled(quarters, 2)
        else:
            seen = _seen(sampled(six, config.fold))
        cells = seen[:, 6:]
        told: list[Tensor] = []
        masks: list[Tensor | None] = [None]
        for step, size in zip(config.steps, self._sizes[1:], strict=True):
            cells = F.avg_pool2d(cells, step)
            here = sampled(seen, size // config.fold)
            nearness = here[:, 6:] * (1 / (here[:, 5:6] * -1).clamp_min(0.25))
            around = horizons(here, config.rings, together=True)
            told.append(torch.cat([here[:, :3], nearness, cells, around], 1))
            masks.append((cells * 1e6).clamp(0, 1) if size >= _MASKED else None)
        return horizons(seen, config.fine_rings), nearest, told, masks


def _seen(six: Tensor) -> Tensor:
    """Normals and positions (N, 6, h, w) as `horizons` takes them: (N, 7, h, w)."""
    normal, position = torch.split(six, 3, 1)
    return torch.cat([unit(normal), position, _covered(position[:, 2:])], 1)


def _covered(z: Tensor) -> Tensor:
    """1 where there is geometry, of the same shape; nearer than 1e-4 radii nothing can be."""
    return (z * -1e4).clamp(0, 1)


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


@contextmanager
def _full_precision() -> Iterator[None]:
    """No automatic 16-bit arithmetic inside."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
