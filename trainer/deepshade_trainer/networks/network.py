"""What all networks have in common, and how their configurations are checked."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from deepshade.errors import ConfigError
from deepshade_trainer.networks.receptive_field import Span, halo


class Network(nn.Module, ABC):
    """Base of all networks: a G-buffer (N, C, H, W) in, an image (N, outputs, H, W) out.

    Unbounded, and no part of it is set apart as background: see `Shader`. H and W are multiples
    of `size_multiple`. An output depends on the inputs of its `receptive_field` alone, so that
    tiles equal the whole.
    """

    # Whether light passes linearly, three colours at once: then no curve stands before or after.
    linear = False
    # Convolutions may be calculated in 16 and 8 bits where their weights' names begin so. If only
    # some may, all that doesn't lie between those is calculated in float32. None: none may.
    rounded: str | None = ""
    # Whether nothing of it is learnt, but for what it takes over, frozen, from another network.
    calculated = False
    # What it sees, where that is something else than the effect's inputs.
    attributes: tuple[str, ...] = ()
    # What it is given of an environment beside the G-buffer: names in `environments.INPUTS`.
    environment: tuple[str, ...] = ()

    @property
    @abstractmethod
    def size_multiple(self) -> int:
        """Height and width must be multiples of this many pixels."""

    @abstractmethod
    def receptive_field(self, pixel: int) -> Span:
        """The input columns that the output column `pixel` depends on (rows are alike)."""

    @abstractmethod
    def forward(self, gbuffer: Tensor) -> Tensor:
        """(N, C, H, W) to (N, outputs, H, W). What `environment` names comes after the G-buffer."""

    @property
    def halo(self) -> int:
        """How many pixels away an input may change an output, at most: exact, by construction."""
        return halo(self.receptive_field, self.size_multiple)

    def prepare_export(self) -> None:
        """Lay the weights out as engines like them best; the answer stays."""


def constant(values: Sequence[float], like: Tensor) -> Tensor:
    """(N,), filled in on the device of `like`: no CUDA graph may hold a copy from the host."""
    return torch.stack([like.new_full((), value) for value in values])


def check_types(settings: Any) -> None:
    """Raise ConfigError for a field of a settings dataclass that isn't of its default's type."""
    for field in dataclasses.fields(settings):
        default, value = field.default, getattr(settings, field.name)
        if default is dataclasses.MISSING or (default is None and value is None):
            continue
        wanted: Any = (int, float) if isinstance(default, float) else type(default)
        if default is None:
            wanted = int
        good = isinstance(value, wanted) and not isinstance(value, bool)
        if isinstance(value, tuple):
            good = good and all(type(v) is int and v >= 0 for v in value)
        if not good:
            raise ConfigError(
                field.name, detail=f"{field.name} can't be {value!r}, it is like {default!r}"
            )


@contextmanager
def full_precision() -> Iterator[None]:
    """No automatic 16-bit arithmetic inside."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
