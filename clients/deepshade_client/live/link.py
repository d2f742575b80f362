"""How fast the link is, and which codec is soonest through it."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable
from typing import Any

from numpy.typing import NDArray

from deepshade import live
from deepshade.live import codecs

_MB = 1e6

# codec -> (bytes before : after, MB/s in, MB/s out) of one core: `benchmarks/codecs.py`, G-buffers
# of 16-bit normals and 32-bit depth
_MEASURED = {
    "raw": (1.0, 4400.0, 200_000.0),
    "lz4": (2.0, 380.0, 1200.0),
    "zstd": (2.6, 250.0, 750.0),
    "deflate": (3.0, 290.0, 150.0),
    "htj2k": (2.8, 110.0, 260.0),
}
_STRIP = 48  # rows that are tried
_KEPT = 8  # measurements whose median counts
_CHANGE = 0.85  # of what the present codec takes, before another one is chosen


class Link:
    """Learns from each frame: bytes per second, and how much each codec makes of what is sent."""

    def __init__(self, known: Collection[str], fixed: str | None = None) -> None:
        self._codecs = [name for name in live.available() if name in known]
        self._ratio = {name: _MEASURED[name][0] for name in self._codecs}
        self._rates: deque[float] = deque(maxlen=_KEPT)
        self._fixed = fixed
        self.codec = fixed or ("lz4" if "lz4" in self._codecs else "deflate")

    def learn(self, planes: Iterable[NDArray[Any]]) -> None:
        """What each codec makes of a strip of these planes: pictures differ more than codecs."""
        strips = [plane[len(plane) // 2 :][:_STRIP] for plane in planes]
        before = sum(strip.nbytes for strip in strips)
        for codec in self._codecs:
            after = sum(len(codecs.encode(strip, codec)) for strip in strips)
            self._ratio[codec] = before / max(after, 1)

    @property
    def bytes_s(self) -> float | None:
        """The median of the last measurements; None before the first."""
        return sorted(self._rates)[len(self._rates) // 2] if self._rates else None

    def packed(self, codec: str, before: int, after: int) -> None:
        """A frame's bytes, before and after its codec."""
        old = self._ratio.get(codec, 1.0)
        self._ratio[codec] = 0.8 * old + 0.2 * before / max(after, 1)

    def sent(self, size: int, seconds: float) -> None:
        """So many bytes took so long to arrive, without what an empty message takes."""
        self._rates.append(size / max(seconds, 1e-5))

    def choose(self, size: int) -> str:
        """The codec for a frame of so many bytes: the soonest there, and the most frames.

        A frame's age is the sum of packing, link and unpacking; the interval between two is the
        slowest of them, for they overlap. The sum of both counts. The one in use stays unless
        another is clearly better, lest it change to and fro.
        """
        rate = self.bytes_s
        if self._fixed is None and rate is not None:
            times = {name: self._seconds(name, size, rate) for name in self._codecs}
            best = min(times, key=lambda name: times[name])
            if times[best] < _CHANGE * times.get(self.codec, float("inf")):
                self.codec = best
        return self.codec

    def _seconds(self, codec: str, size: int, rate: float) -> float:
        _, pack, unpack = _MEASURED[codec]
        took = size / (pack * _MB), size / self._ratio[codec] / rate, size / (unpack * _MB)
        return sum(took) + max(took)
