"""How much memory a picture takes, and how much of it one prediction may use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

from deepshade import exr
from deepshade.engines import Engine
from deepshade.errors import LimitError
from deepshade.threads import thread_count
from deepshade_service.tiles import padded, smallest_tile

# What one request may take of the memory, so that small ones still run beside a big one.
_SHARE = 0.75
# A picture gets by with so much, or with so many times what it holds anyway. Larger tiles spare
# overlap, but that soon costs more memory than it is worth.
_USUAL = 7 * 2**27  # 7/8 GiB: a 3840 x 2160 answer stays below 1 GiB
_TIMES = 1.5
_MARKERS = 3  # channels that only mark the background: depth, distance, alpha
_STRIP = 8 * 2**20  # what `exr` decodes at a time, unless the file's own pieces are larger


@dataclass(frozen=True, slots=True)
class Room:
    """Bytes that a whole job needs, and those of them that one prediction may use."""

    needed: int
    tile_bytes: int

    def max_pixels(self, engine: Engine) -> int:
        """The pixels that a tile may have."""
        return self.tile_bytes // bytes_per_pixel(engine)


def bytes_per_pixel(engine: Engine) -> int:
    """What a tile's pixel takes: within the engine, and as its input and output."""
    return engine.bytes_per_pixel + 4 * (engine.channels + len(engine.bundle.outputs))


def _decoding(headers: Sequence[exr.Header]) -> int:
    """Bytes that decoding takes beside what comes out: strips of all channels, on many threads."""
    parts = [part for header in headers for part in header.parts]
    largest = max(
        part.decoded_bytes if part.subsampled else part.decoded_bytes // part.chunks.rows
        for part in parts
    )
    strips = 2 * thread_count() * max(_STRIP, largest)
    return min(strips, sum(part.decoded_bytes for part in parts))


def size_of(headers: Sequence[exr.Header]) -> tuple[int, int]:
    """(height, width) of the largest part: any may turn out to be the one that is shaded."""
    return max((part.shape for header in headers for part in header.parts), key=prod)


def room_for(headers: Sequence[exr.Header], engine: Engine, total: int, *, spare: int = 1) -> Room:
    """What shading these files takes of `total` bytes, by their headers alone.

    A tile gets `spare` times what this engine needs, where there is that much, in case another
    takes its place. Raises LimitError when the total is too small even for the smallest tiles.
    """
    bundle, per_pixel = engine.bundle, bytes_per_pixel(engine)
    height, width = size_of(headers)
    # Throughout: the files, their channels as float32 with masks, the answer and its copies.
    pixel = 4 * engine.channels + 4 + 12 * len(bundle.outputs)
    held = sum(header.body_bytes for header in headers) + pixel * width * height
    # First strips of all channels as they are stored and what marks the background, then what
    # the inputs may be derived from, and after that, in the same room, the network.
    sources = 4 * engine.channels * width * height
    decoded = max(sources, _decoding(headers) + 4 * _MARKERS * width * height)
    multiple, halo = bundle.size_multiple, bundle.halo
    smallest = per_pixel * smallest_tile(height, width, multiple=multiple, halo=halo)
    least = held + max(decoded, smallest)
    if least > total:
        raise LimitError("memory_bytes", least, total)
    most = max(min(_SHARE * total, max(_USUAL, _TIMES * held)), least)
    room = int(most) - held
    tile_bytes = min(room, spare * per_pixel * prod(padded(height, width, multiple)))
    return Room(held + max(decoded, tile_bytes), tile_bytes)
