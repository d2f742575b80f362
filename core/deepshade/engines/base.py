"""The interface of an engine, and what all of them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.machine import resident, trim
from deepshade.threads import busy

Float = NDArray[np.float32]

_PROBE = 512  # side of the picture that measures the memory per pixel
_FALLBACK_BYTES_PER_PIXEL = 1024


@dataclass(frozen=True, slots=True, order=True)
class Backend:
    """What runs a network, and how exactly it calculates: "openvino" in "bf16"."""

    engine: str
    precision: str

    def __str__(self) -> str:
        return f"{self.engine}/{self.precision}"


class Engine(ABC):
    """One bundle's network on one backend.

    `channels` is how many the network reads. `bytes_per_pixel` is the memory that a prediction
    needs for each input pixel, measured in `warm`. `threads` is what a prediction may use when
    no other runs. `predict` may be called from several threads at once.
    """

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        self.bundle = bundle
        self.backend = backend
        self.threads = threads
        self.channels = channels_of(bundle)
        self.bytes_per_pixel = _FALLBACK_BYTES_PER_PIXEL

    def warm(self) -> None:
        """Run twice: small, so that weights are laid out; then large, to measure the memory."""
        side = self.bundle.size_multiple
        small = np.zeros((1, self.channels, side, side), np.float32)
        for threads in {1, self.threads}:
            self._run(small, threads)
        side = max(side, _PROBE // side * side)
        probe = np.zeros((1, self.channels, side, side), np.float32)
        self.shrink()
        trim()  # else what others freed would be used again, and not be counted
        before = resident()
        self.predict(probe)
        used = resident() - before
        if used > 0:
            # At least what goes in and comes out, twice: the reading may be off on a busy start.
            floor = 8 * (self.channels + len(self.bundle.outputs))
            self.bytes_per_pixel = max(floor, round(used / side**2))
        self.shrink()

    def predict(self, gbuffer: Float) -> Float:
        """(N, C, H, W) to (N, C', H, W), H and W multiples of the bundle's size multiple."""
        with busy() as at_once:
            return self._run(gbuffer, max(1, self.threads // at_once))

    def prepare(self, height: int, width: int) -> None:  # noqa: B027 (most need nothing)
        """Be as fast as can be for one input of this size at a time; blocks.

        Otherwise that comes with use.
        """

    def device_ms(self, gbuffer: Float, runs: int = 20) -> float | None:
        """Median milliseconds of a prediction whose pixels are on the device and stay there.

        None where the engine can't leave them there.
        """
        return None

    @abstractmethod
    def _run(self, gbuffer: Float, threads: int) -> Float:
        """`predict` on at most `threads` threads."""

    @abstractmethod
    def shrink(self) -> None:
        """Free the memory that earlier predictions left behind."""


def channels_of(bundle: Bundle) -> int:
    """The channels that a bundle's network reads; a per-channel effect sees one colour channel."""
    single = EFFECTS[bundle.effect].per_channel
    return sum(
        1 if single and ATTRIBUTES[name].kind == "colour" else len(ATTRIBUTES[name].channels)
        for name in bundle.inputs
    )
