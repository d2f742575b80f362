"""The interface of all bases."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor, nn

from deepshade_trainer.networks.receptive_field import Span

State = tuple[Tensor, ...]


class Bases(nn.Module, ABC):
    """Light filtered in several ways, and how weights blend them. All of it is float32.

    `told` is how many channels the network that predicts the weights is given, `weights` how many
    it gives; both have a value for each square of `cell` x `cell` pixels. All weights 0 is the
    classical answer. A pixel's answer depends on the weights up to `reach` pixels away.
    """

    told: ClassVar[int]
    weights: ClassVar[int]
    size_multiple: ClassVar[int] = 1
    cell: ClassVar[int] = 1
    reach: ClassVar[int] = 0

    @abstractmethod
    def features(self, gbuffer: Tensor) -> tuple[Tensor, State]:
        """What the network is told (N, told, H / cell, W / cell), bounded, and `carry`'s needs."""

    @abstractmethod
    def carry(self, state: State, weights: Tensor) -> Tensor:
        """The answer (N, 3, H, W) by weights (N, weights, H / cell, W / cell): linear in light."""

    @abstractmethod
    def receptive_field(self, pixel: int) -> Span:
        """See `Network.receptive_field`."""
