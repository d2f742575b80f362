"""Our network: pixels folded into channels, dense convolutions, geometry at every scale."""

from __future__ import annotations

import itertools
import operator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.errors import ConfigError
from deepshade_trainer.networks.edges import edges, second_differences
from deepshade_trainer.networks.horizons import covered, directions, horizons, sampled, unit
from deepshade_trainer.networks.network import Network, check_types, full_precision
from deepshade_trainer.networks.receptive_field import Span, folded, grown, joined
from deepshade_trainer.networks.stack import Stack

# Levels whose cells are this many pixels wide keep those without geometry at zero.
_MASKED = 16
# What a coarse cell is told besides its horizons: normal, R/z, coverage.
_TOLD = 5


@dataclass(frozen=True)
class FoldConfig:
    """The shape of a `FoldUNet`.

    `fold` x `fold` pixels become a cell. `widths` are the channels of each level, finest first;
    levels are `steps` times coarser than the one before, and have `down` convolutions of 3 x 3 on
    the way down and `up` on the way up. `normal` and `position` are the first of their three input
    channels; with both, every level is told its `horizons`, found `rings` cells away, the first
    `fine_rings`, and also those of its cells' quarters, `detail` quarters away, unless that is
    empty. Where `fine` isn't 0, outputs are made of half as large cells of so many channels, which
    are told the normals and `edges` of their pixels. `bias` is what the outputs begin at.
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
    fine: int = 0
    normal: int | None = None
    position: int | None = None
    bias: float = 0.0

    def __post_init__(self) -> None:
        """Raise ConfigError where entries don't fit each other."""
        check_types(self)
        levels = len(self.widths)
        if (len(self.down), len(self.up), len(self.steps)) != (levels, levels - 1, levels - 1):
            raise ConfigError(
                "widths",
                detail="down needs an entry for each of the widths, up and steps one fewer",
            )
        for name in ("rings", "fine_rings"):
            if not (rings := getattr(self, name)) or min(rings) < 1:
                raise ConfigError(name, detail=f"{name} are distances of 1 cell or more")
        if self.detail and (min(self.detail) < 1 or self.fold % 2):
            raise ConfigError(
                "detail", detail="detail are distances of 1 quarter or more, and need an even fold"
            )
        if self.fine < 0:
            raise ConfigError("fine", detail="fine is a number of channels, or 0 for none")
        if self.fine and (self.fold % 2 or self.normal is None or self.position is None):
            raise ConfigError("fine", detail="fine needs an even fold, normals and positions")


class FoldUNet(Network):
    """Our network: pixels folded into channels, dense convolutions, geometry at every scale.

    With normals and positions each cell is told its horizons at every level: what occludes it;
    with `detail`, the finest also those of its four quarters, for what is thinner than a cell.
    With `fine`, the answer is made to the pixel: what cells know meets where the pixels' edges are.
    They are float32 arithmetic before the first convolution, so that engines can run the
    convolutions in 16 bits while no large position ever matters to one. Nothing has a bias where
    there is no geometry, and coarse cells without geometry are kept at zero: to the pixels around
    it background is the same as the edge of the picture.

    Without normals or positions there are no horizons, and all inputs are raw.
    """

    filters: Tensor  # of `edges`

    def __init__(self, config: FoldConfig) -> None:
        super().__init__()
        self.config = config
        self.geometric = config.normal is not None and config.position is not None
        widths, fold = config.widths, config.fold
        # Raw positions are too large for a convolution in 16 bits; everything else is welcome.
        raw = config.inputs - 3 if self.geometric else config.inputs
        self.stem = nn.Conv2d(raw, widths[0], fold, stride=fold, bias=False)
        if self.geometric:
            near, around = directions(config.fine_rings), directions(config.rings)
            self.horizon = nn.Conv2d(near, widths[0], 1, bias=False)
            if config.detail:
                quarters = directions(config.detail)
                self.detail = nn.Conv2d(quarters, widths[0], 2, stride=2, bias=False)
                # small, so that a network trained without it can go on with it
                nn.init.normal_(self.detail.weight, std=0.01)
            self.tell = nn.ModuleList(
                nn.Conv2d(_TOLD + around, width, 1, bias=False) for width in widths[1:]
            )
        self.encode = nn.ModuleList(map(Stack, widths, config.down))
        pairs = list(zip(itertools.pairwise(widths), config.steps, strict=True))
        self.downsample = nn.ModuleList(
            nn.Conv2d(fine, coarse, step, stride=step, bias=False) for (fine, coarse), step in pairs
        )
        self.upsample = nn.ModuleList(
            nn.ConvTranspose2d(coarse, fine, step, stride=step, bias=False)
            for (fine, coarse), step in pairs
        )
        self.decode = nn.ModuleList(map(Stack, widths[:-1], config.up))
        last, size = config.fine or widths[0], self._size
        if config.fine:
            filters = second_differences(size)
            self.register_buffer("filters", filters, persistent=False)
            self.fine_stem = nn.Conv2d(raw, last, size, stride=size, bias=False)
            self.edge = nn.Conv2d(len(filters), last, 1, bias=False)
            self.fine_upsample = nn.ConvTranspose2d(widths[0], last, 2, stride=2, bias=False)
            self.fine = Stack(last, 1)
        self.head = nn.Conv2d(last, config.outputs * size**2, 3, padding=1)
        nn.init.normal_(self.head.weight, std=0.01)
        nn.init.constant_(self.head.bias, config.bias)  # type: ignore[arg-type]

    def forward(self, gbuffer: Tensor, first: int = 0) -> Tensor:
        """See `Network.forward`.

        Geometric inputs that end in positions may begin at the channel `first` of many.
        """
        return self.pixels(self.cells(gbuffer, first))

    def pixels(self, x: Tensor) -> Tensor:
        """The outputs (N, outputs, H, W), float32, of what `cells` made of a G-buffer."""
        # bf16 has only 1/256 between 0.5 and 1, where most of an occlusion image lies.
        with full_precision():
            x = self.head(x.to(self.head.weight.dtype)).float()  # (N, outputs size², h, w)
            return F.pixel_shuffle(x, self._size)

    def cells(self, gbuffer: Tensor, first: int = 0) -> Tensor:
        """All but the last convolution: (N, C, H, W) to (N, widths[0], H / fold, W / fold).

        With `fine` that is (N, fine, 2 H / fold, 2 W / fold).
        """
        config = self.config
        raw = self._raw(gbuffer, first)
        x = _folded(raw, self.stem)  # (N, widths[0], H / fold, W / fold)
        told: list[Tensor] = []
        masks: list[Tensor | None] = [None] * len(config.widths)
        if self.geometric:
            with full_precision():
                near, nearest, told, masks = self.features(gbuffer, first)
            x = x + self.horizon(near)
            if nearest is not None:
                x = x + self.detail(nearest)
        x = F.relu(x)
        skips = []
        for n, stack in enumerate(self.encode):
            if n:
                x = self.downsample[n - 1](x)  # (N, widths[n], h / step, w / step)
                x = F.relu(x + self.tell[n - 1](told[n - 1]) if told else x)
            x = stack(x, masks[n])
            skips.append(x)
        for n in reversed(range(len(self.decode))):
            x = F.relu(skips[n] + self.upsample[n](x))  # (N, widths[n], step h, step w)
            x = self.decode[n](x, masks[n])
        if config.fine:
            depth = first + (config.position or 0) + 2
            with full_precision():
                edge = edges(gbuffer[:, depth : depth + 1], self._size, self.filters)
            x = self.fine_upsample(x) + _folded(raw, self.fine_stem) + self.edge(edge)
            x = self.fine(F.relu(x))
        return x

    def _raw(self, gbuffer: Tensor, first: int) -> Tensor:
        """All but positions, and what else may come with them (see `_folded`): (N, C, H, W)."""
        place = self.config.position or 0
        if not self.geometric:
            return gbuffer
        if place + 3 == self.config.inputs:
            # All that is raw comes first. An odd number of channels would be slower in 16 bits.
            return gbuffer[:, first : first + place + place % 2]
        return torch.cat([gbuffer[:, :place], gbuffer[:, place + 3 :]], 1)

    def prepare_export(self) -> None:
        """Pad the stems' weights where `_folded` does: the graph then holds them by their name."""
        place = self.config.position or 0
        if self.geometric and place + 3 == self.config.inputs and place % 2:
            for stem in [self.stem, *([self.fine_stem] if self.config.fine else [])]:
                stem.weight = nn.Parameter(F.pad(stem.weight, (0, 0, 0, 0, 0, 1)))

    def features(
        self, gbuffer: Tensor, first: int = 0
    ) -> tuple[Tensor, Tensor | None, list[Tensor], list[Tensor | None]]:
        """What the positions of a G-buffer (N, inputs, H, W) tell, all in float32.

        Returns the first level's horizons (N, `directions`, h, w); those of its cells' quarters
        (N, `directions`, 2h, 2w), or None without `detail`; for each level but the first what its
        cells are told (N, 5 + `directions`, h, w); and for each level its mask of cells with
        geometry (N, 1, h, w), or None.
        """
        config = self.config
        start, place = (first + (at or 0) for at in (config.normal, config.position))
        if place == start + 3:
            six = gbuffer if gbuffer.shape[1] == 6 else gbuffer[:, start : start + 6]
        else:
            six = torch.cat([gbuffer[:, start : start + 3], gbuffer[:, place : place + 3]], 1)
        # One pixel stands for its cell. A mean would lie in the air where a cell shows an edge.
        nearest = None
        if config.detail:
            quarters = _seen(sampled(six, config.fold // 2, 0))  # (N, 7, 2h, 2w)
            nearest = horizons(quarters, config.detail)
            seen = sampled(quarters, 2)
        else:
            seen = _seen(sampled(six, config.fold))  # (N, 7, h, w)
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

    @property
    def size_multiple(self) -> int:
        """One cell of the coarsest level."""
        return self._sizes[-1]

    @property
    def _size(self) -> int:
        """Pixels along the side of a cell that outputs are made of."""
        return self.config.fold // 2 if self.config.fine else self.config.fold

    @property
    def _sizes(self) -> list[int]:
        """Pixels along a cell's side, at each level."""
        return list(itertools.accumulate(self.config.steps, operator.mul, initial=self.config.fold))

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        config, pixels = self.config, (pixel, pixel)
        span = grown((pixel // self._size, pixel // self._size), 1)
        if config.fine:
            span = grown(span, 1)
            pixels = grown(folded(span, self._size), 1)
            span = span[0] // 2, span[1] // 2
        skips = []
        for step, count in zip(config.steps, config.up, strict=True):
            span = grown(span, count)
            skips.append(span)
            span = span[0] // step, span[1] // step
        for n in reversed(range(len(config.widths))):
            if n < len(skips):
                span = joined(folded(span, config.steps[n]), skips[n])
            span = grown(span, config.down[n])
            if self.geometric:
                first, last = grown(span, max(config.rings if n else config.fine_rings))
                size = self._sizes[n]
                pixels = joined(
                    pixels, (self._sampled_at(first, size), self._sampled_at(last, size))
                )
        if self.geometric and config.detail:
            half = grown(folded(span, 2), max(config.detail))
            pixels = joined(pixels, (half[0] * config.fold // 2, half[1] * config.fold // 2))
        return joined(pixels, folded(span, config.fold))

    def _sampled_at(self, cell: int, size: int) -> int:
        """The pixel that stands for a cell of `size` pixels: see `features`."""
        fold = self.config.fold
        return cell * size + size // fold // 2 * fold + fold // 2


def _seen(six: Tensor) -> Tensor:
    """Normals and positions (N, 6, h, w) as `horizons` takes them: (N, 7, h, w)."""
    normal, position = torch.split(six, 3, 1)
    return torch.cat([unit(normal), position, covered(position[:, 2:])], 1)


def _folded(raw: Tensor, stem: nn.Conv2d) -> Tensor:
    """`stem` of its channels of `raw`, which may have one more."""
    weight = stem.weight
    if weight.shape[1] < raw.shape[1]:
        weight = F.pad(weight, (0, 0, 0, 0, 0, 1))
    return F.conv2d(raw, weight, stride=stem.stride)
