"""Our network for light from all around: geometry decides what is open to each direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from deepshade.environments.lamps import fibonacci
from deepshade.errors import ConfigError
from deepshade_trainer.networks.fold_unet import FoldConfig, FoldUNet, full_precision
from deepshade_trainer.networks.horizons import covered, unit
from deepshade_trainer.networks.network import Network, check_types
from deepshade_trainer.networks.receptive_field import Span
from deepshade_trainer.networks.reflections import blurred, mean, turned

# Of a sample: row and column of a pixel in its cells; which directions it is open to
# (directions, h, w); these (directions, 3); and how much of each a lobe sees (lobes, directions).
Probe = tuple[Tensor, Tensor, Tensor, Tensor]

LEVEL = 5  # the map is seen through lobes of exponent 2^LEVEL
_HALVES = 4  # vectors are found for 2 x 2 parts of a cell
_SURFACE = 0.25  # the square of a normal's length; background has none


@dataclass(frozen=True)
class OpeningsConfig:
    """The shape of the trunk (`FoldConfig`), and of what it tells.

    `features` of a cell say what is open, in as many `directions`. `world`, `normal` and `position`
    are the first of three channels of the G-buffer each: the normal in world space and in camera
    space, and the position.
    """

    kind: str = "openings"
    inputs: int = 9
    outputs: int = 3
    features: int = 64
    directions: int = 96
    widths: tuple[int, ...] = (48, 96, 128)
    steps: tuple[int, ...] = (4, 2)
    down: tuple[int, ...] = (1, 2, 2)
    up: tuple[int, ...] = (2, 2)
    fold: int = 4
    rings: tuple[int, ...] = (1, 1, 2, 2, 4, 4)
    fine_rings: tuple[int, ...] = (1, 1, 2, 3, 5, 8)
    detail: tuple[int, ...] = (1, 1)
    bias: float = 0.85
    world: int = 0
    normal: int = 3
    position: int = 6

    def __post_init__(self) -> None:
        """Raise ConfigError where entries don't fit each other."""
        check_types(self)
        for name in ("features", "directions"):
            if getattr(self, name) < 1:
                raise ConfigError(name, detail=f"{name} must be 1 or more")
        if self.fold % 2:
            raise ConfigError("fold", detail="fold must be even")
        if self.normal + 3 != self.position:
            raise ConfigError("position", detail="positions must follow normals")
        _ = self.trunk

    @property
    def trunk(self) -> FoldConfig:
        """The network that ambient occlusion has too."""
        names = ("widths", "steps", "down", "up", "fold", "rings", "fine_rings", "detail", "bias")
        shared: dict[str, Any] = {name: getattr(self, name) for name in names}
        return FoldConfig(inputs=6, outputs=1, normal=0, position=3, **shared)


class Openings(Network):
    """Light from all around (N, 3, H, W) where a surface lies open to it:

        ao I(N) + Σ_k (r_k + N·v_k) (E_k - Ē)

    I is the irradiance over π of the open surface, looked up; E_k is the map through a lobe about
    the k-th of many directions in camera space, and Ē their mean. The trunk gives ao, and features
    from which r_k and v_k are made linearly. So the sum over k is done first, on the weights, and
    costs nothing however many there are; the answer is linear in the map; and under a white one it
    is ao. Where there is no surface stands the map's mean.
    """

    linear = True
    rounded = "trunk."
    environment = ("lobes", "turn", "camera")
    towards: Tensor

    def __init__(self, config: OpeningsConfig) -> None:
        super().__init__()
        self.config = config
        self.trunk = _Trunk(config)
        self.planes = 3 * _HALVES + config.fold**2
        weights = torch.randn(config.directions, self.planes * config.features)
        self.weights = nn.Parameter(weights * 0.02)
        towards = torch.from_numpy(fibonacci(config.directions).T).float()
        self.register_buffer("towards", towards[None, :, None], persistent=False)

    @property
    def size_multiple(self) -> int:
        """See `Network.size_multiple`."""
        return self.trunk.size_multiple

    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
        return self.trunk.receptive_field(pixel)

    def forward(self, gbuffer: Tensor, *given: Tensor) -> Tensor:
        """(1, 9, H, W), the table of `environments.lobes`, the turns from world and from camera to
        the map (3, 3), to (1, 3, H, W)."""
        lobes, turn, camera = given
        with full_precision():
            start = self.config.world
            normal = gbuffer[:, start : start + 3]
            seen = blurred(lobes, turned(normal, turn), 0)
            around = mean(lobes)
            surface = (normal * normal).sum(1, keepdim=True) > _SURFACE
            surface = surface & (self._covered(gbuffer) > 0)
            irradiance = torch.where(surface, seen, around)
            through = blurred(lobes, turned(self.towards, camera), LEVEL)  # (1, 3, 1, K)
        return self.lit(gbuffer, irradiance, through[:, :, 0])

    def lit(self, gbuffer: Tensor, irradiance: Tensor, through: Tensor) -> Tensor:
        """(N, C, H, W) for a G-buffer under C / 3 maps at once.

        `irradiance` (N, C, H, W) is that of the open surface, over π, and of background the map's
        mean; `through` (N, C, directions) the maps in camera space, through lobes.
        """
        return self._lit(gbuffer, *self.told(gbuffer), irradiance, through)

    def told(self, gbuffer: Tensor) -> tuple[Tensor, Tensor]:
        """Ambient occlusion (N, 1, H, W), and features (N, features, h, w) of cells."""
        occlusion, features = self.trunk(gbuffer, self.config.normal)
        return occlusion, features.float()

    def learnt(
        self, gbuffer: Tensor, irradiance: Tensor, through: Tensor, probes: Sequence[Probe]
    ) -> tuple[Tensor, Tensor]:
        """`lit`, and the mean square error of what is open to each direction, times its cosine.

        A probe is of one sample each, at one pixel of every cell.
        """
        occlusion, features = self.told(gbuffer)
        errors = [
            self._error(gbuffer[k], occlusion[k, 0], features[k], *probe)
            for k, probe in enumerate(probes)
        ]
        return self._lit(gbuffer, occlusion, features, irradiance, through), torch.stack(
            errors
        ).mean()

    def _error(
        self,
        gbuffer: Tensor,
        occlusion: Tensor,
        features: Tensor,
        at: Tensor,
        open_: Tensor,
        towards: Tensor,
        shares: Tensor,
    ) -> Tensor:
        fold, first = self.config.fold, self.config.normal
        row, column = (int(v) for v in at)
        cells = gbuffer[:, row::fold, column::fold].flatten(1)  # (C, cells)
        normal = unit(cells[None, first : first + 3, None])[0, :, 0]
        half = row * 2 // fold * 2 + column * 2 // fold
        planes = [*(axis * _HALVES + half for axis in range(3))]
        planes.append(3 * _HALVES + row * fold + column)
        weights = self.weights.reshape(len(self.weights), self.planes, -1)[:, planes]
        told = weights @ features.flatten(1) * (1 / self.config.features)  # (K, 4, cells)
        blend = (told[:, :3] * normal).sum(1) + told[:, 3]
        contrast = shares - shares.mean(0, keepdim=True)  # (K, directions)
        cosine = (towards @ normal).clamp_min(0)
        there = occlusion[row::fold, column::fold].flatten()
        found = there * cosine + contrast.T @ blend * (len(towards) / 4)
        inside = covered(cells[first + 5])
        return ((found - open_.flatten(1) * cosine) ** 2 * inside).mean()

    def _lit(
        self,
        gbuffer: Tensor,
        occlusion: Tensor,
        features: Tensor,
        irradiance: Tensor,
        through: Tensor,
    ) -> Tensor:
        config, first = self.config, self.config.normal
        with full_precision():
            count, colours, _ = through.shape
            high, wide = features.shape[2:]
            planes, width = self.planes, config.features
            # divided, so that weights are learnt at the pace of all others
            contrast = (through - through.mean(2, keepdim=True)) * (1 / width)
            weights = contrast @ self.weights  # (N, C, planes * features)
            weights = weights.reshape(count, colours * planes, width)
            told = weights @ features.flatten(2)
            told = told.reshape(count * colours, planes, high, wide)
            vectors = F.pixel_shuffle(told[:, : 3 * _HALVES], 2)  # (N C, 3, 2h, 2w)
            vectors = F.interpolate(vectors, scale_factor=config.fold / 2, mode="nearest")
            rest = F.pixel_shuffle(told[:, 3 * _HALVES :], config.fold)
            normal = unit(gbuffer[:, first : first + 3])
            size = normal.shape[2:]
            vectors = vectors.reshape(count, colours, 3, *size)
            learnt = (vectors * normal[:, None]).sum(2) + rest.reshape(count, colours, *size)
            inside = self._covered(gbuffer)
            return irradiance + inside * ((occlusion - 1) * irradiance + learnt)

    def _covered(self, gbuffer: Tensor) -> Tensor:
        last = self.config.position + 2
        return covered(gbuffer[:, last : last + 1])

    def prepare_export(self) -> None:
        """See `Network.prepare_export`."""
        self.trunk.prepare_export()


class _Trunk(FoldUNet):
    """Ambient occlusion (N, 1, H, W), and features (N, features, h, w) of each cell."""

    def __init__(self, config: OpeningsConfig) -> None:
        super().__init__(config.trunk)
        self.tells = nn.Conv2d(config.widths[0], config.features, 3, padding=1)

    def forward(  # type: ignore[override]
        self, gbuffer: Tensor, first: int = 0
    ) -> tuple[Tensor, Tensor]:
        x = self.cells(gbuffer, first)
        return self.pixels(x), F.relu(self.tells(x))
