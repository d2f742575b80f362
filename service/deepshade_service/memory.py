"""Memory: what a picture takes, and a budget that requests share, first come, first served."""

from __future__ import annotations

import asyncio
import re
from collections import deque
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from math import prod

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, LimitError
from deepshade.tensors import channel_count
from deepshade.threads import thread_count
from deepshade_service.tiles import min_tile, padded

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}

# What one request may take of the memory, so that small ones still run beside a big one.
_SHARE = 0.75
# A picture gets by with so much, or with so many times what it holds anyway. Larger tiles spare
# overlap, but that soon costs more memory than it is worth.
_USUAL = 7 * 2**27  # 7/8 GiB: a 3840 x 2160 answer stays below 1 GiB
_TIMES = 1.5
_MARKERS = 3  # channels that only mark the background: depth, distance, alpha
_STRIP = 8 * 2**20  # what `exr` decodes at a time, unless the file's own pieces are larger


def parse_size(text: str | int) -> int:
    """Bytes in '1536M', '2g', '1.5 GiB' or a plain number; ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?\s*", str(text).lower())
    if match is None:
        raise ConfigError("memory", detail=f"'{text}' is no size; write for example 512M or 2G")
    return int(float(match[1]) * _UNITS[match[2]])


class MemoryBudget:
    """Bytes that requests share, so that their sum is bounded.

    Who comes first is served first: a large request isn't passed by small ones for ever. Only
    for use on the event loop.
    """

    def __init__(self, total: int) -> None:
        self.total = total
        self._free = total
        self._waiting: deque[tuple[int, asyncio.Future[None]]] = deque()

    @asynccontextmanager
    async def hold(self, amount: int) -> AsyncIterator[None]:
        """Hold `amount` bytes (at most the total) within the block; waits for them."""
        amount = min(amount, self.total)
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append((amount, turn))
        self._serve()
        try:
            await turn
            yield
        finally:
            if turn.done() and not turn.cancelled():
                self._free += amount
            self._serve()

    def _serve(self) -> None:
        while self._waiting:
            amount, turn = self._waiting[0]
            if not turn.cancelled():
                if amount > self._free:
                    return
                self._free -= amount
                turn.set_result(None)
            self._waiting.popleft()


@dataclass(frozen=True, slots=True)
class Need:
    """Bytes that a whole job takes, and the pixels that one prediction within it may have."""

    total: int
    max_pixels: int


def need_of(
    headers: Sequence[exr.Header],
    bundle: Bundle,
    total: int,
    beside: Sequence[Bundle] = (),
    more: int = 0,
) -> Need:
    """What shading these files takes of `total` bytes, by their headers alone.

    With other bundles `beside` it, one after the other, all attributes and answers are held
    throughout, and `more` bytes. Raises LimitError when the total is too small even for the
    smallest tiles.
    """
    bundles = {each.effect: each for each in (bundle, *beside)}
    outputs = sum(len(EFFECTS[effect].outputs) for effect in bundles)
    inputs = dict.fromkeys(name for each in bundles.values() for name in each.inputs)
    channels = channel_count(inputs, per_channel=False)
    height, width = size_of(headers)
    # Throughout: the files, their channels as float32 with masks, the answers and their copies.
    pixel = 4 * channels + 4 + 12 * outputs
    held = sum(header.body_bytes for header in headers) + pixel * width * height + more
    # First strips of all channels as they are stored and what marks the background, then what
    # the inputs may be derived from, and after that, in the same room, the network.
    sources = 4 * channels * width * height
    decoded = max(sources, _decoding(headers) + 4 * _MARKERS * width * height)
    # What a tile's pixel takes: within the engine, and as its input and output.
    tile = bundle.bytes_per_pixel + 4 * (bundle.channels + len(EFFECTS[bundle.effect].outputs))
    least = held + max(decoded, tile * min_tile(height, width, bundle.size_multiple, bundle.halo))
    if least > total:
        raise LimitError("memory_bytes", least, total)
    most = max(int(min(_SHARE * total, max(_USUAL, _TIMES * held))), least)
    pixels = min((most - held) // tile, prod(padded(height, width, bundle.size_multiple)))
    return Need(held + max(decoded, tile * pixels), pixels)


def bytes_to_read(header: exr.Header, channels: int, total: int) -> int:
    """What it takes to read so many channels of a file and to write them into another.

    Raises LimitError when that is more than the `total`.
    """
    pixels = 3 * 4 * channels * prod(size_of([header]))  # decoded, as stored, encoded
    least = header.body_bytes + pixels + _decoding([header])
    if least > total:
        raise LimitError("memory_bytes", least, total)
    return least


def size_of(headers: Sequence[exr.Header]) -> tuple[int, int]:
    """(height, width) of the largest part: any may turn out to be the one that is shaded."""
    return max((part.shape for header in headers for part in header.parts), key=prod)


def _decoding(headers: Sequence[exr.Header]) -> int:
    """Bytes that decoding takes beside what comes out: strips of all channels, on many threads."""
    parts = [part for header in headers for part in header.parts]
    largest = max(
        part.decoded_bytes if part.subsampled else part.decoded_bytes // part.chunks.rows
        for part in parts
    )
    strips = 2 * thread_count() * max(_STRIP, largest)
    return min(strips, sum(part.decoded_bytes for part in parts))
