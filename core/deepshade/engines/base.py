"""The interface of an engine, and what all of them share."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.bundles import Bundle
from deepshade.environments import black

Float = NDArray[np.float32]

_WARM = 256  # side of the picture that is run first, and timed


@dataclass(frozen=True, slots=True, order=True)
class Backend:
    """What runs a network, and how exactly it calculates: "openvino" in "bf16"."""

    engine: str
    precision: str

    def __str__(self) -> str:
        return f"{self.engine}/{self.precision}"


class Engine(ABC):
    """One bundle's network on one backend, on `threads` CPU threads.

    `predict` may be called from several threads at once. The same input gives the same bytes,
    the first time and the last.
    """

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        self.bundle = bundle
        self.backend = backend
        self.threads = threads
        self.ms_per_megapixel = 0.0

    def warm(self) -> None:
        """Lay out the weights by a first small prediction, and time a second."""
        side = -(-_WARM // self.bundle.size_multiple) * self.bundle.size_multiple
        example = np.zeros((1, self.bundle.channels, side, side), np.float32)
        given = (black(self.bundle.environment),) if self.bundle.environment else ()
        self.predict(example, *given)
        start = time.perf_counter()
        self.predict(example, *given)
        self.ms_per_megapixel = 1e3 * (time.perf_counter() - start) / (side * side / 1e6)
        self.shrink()

    def prepare(self, height: int, width: int) -> None:  # noqa: B027 (most need nothing)
        """Compile what the first prediction of this size would have to; blocks."""

    def sizes(self) -> list[tuple[int, int]]:
        """The (height, width) that are compiled, where that is done for each."""
        return []

    @abstractmethod
    def predict(self, gbuffer: Float, environment: Mapping[str, Float] | None = None) -> Float:
        """(N, C, H, W) to (N, C', H, W), H and W multiples of the bundle's size multiple.

        `environment` holds the graph's further inputs, where the bundle names some.
        """

    @abstractmethod
    def shrink(self) -> None:
        """Free the memory that earlier predictions left behind."""
