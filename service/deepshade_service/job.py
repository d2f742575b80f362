"""One request's work from bytes to bytes, timed, and within its part of the memory."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from math import prod

from deepshade import exr
from deepshade.errors import LimitError
from deepshade_service import shading
from deepshade_service.engine import Engine
from deepshade_service.memory import MemoryBudget, trim
from deepshade_service.parameters import ShadeParameters
from deepshade_service.pool import Cancelled
from deepshade_service.telemetry import Stopwatch
from deepshade_service.tiles import padded, smallest_tile
from deepshade_service.uploads import Upload

# Work that used more hands memory back at once, other work when the service is idle.
_BIG = 512 * 2**20
# What one request may take of the memory, so that small ones still run beside a big one.
_SHARE = 0.75


@dataclass(frozen=True, slots=True)
class Answer:
    """An encoded picture, and how it was made."""

    content: bytes
    media_type: str
    facts: shading.Facts
    pixels: int
    watch: Stopwatch


@dataclass(frozen=True, slots=True)
class Job:
    """What one request asks for; call it on a worker thread."""

    engine: Engine
    files: list[Upload]
    asked: ShadeParameters
    limits: exr.Limits
    memory: MemoryBudget

    def __call__(self, cancelled: threading.Event) -> Answer:
        """Shade the picture. Raises what the four steps raise, and Cancelled."""
        watch = Stopwatch()
        with watch.time("decode"):
            headers = [exr.read_header(file.data, self.limits) for file in self.files]
        needed, tile_bytes = self._memory(headers)
        with self.memory.hold(needed, cancelled):
            if cancelled.is_set():
                raise Cancelled
            try:
                return self._shade(headers, tile_bytes, watch, cancelled)
            finally:
                if needed > _BIG:
                    self.engine.shrink()
                    trim()

    def _shade(
        self,
        headers: list[exr.Header],
        tile_bytes: int,
        watch: Stopwatch,
        cancelled: threading.Event,
    ) -> Answer:
        with watch.time("decode"):
            gbuffer = shading.decode(self.files, headers, self.engine, self.asked, self.limits)
        with watch.time("plan"):
            plan = shading.plan(gbuffer, self.engine, self.asked, tile_bytes)
        with watch.time("infer"):
            shade = shading.infer(gbuffer, plan, self.engine, cancelled)
        with watch.time("encode"):
            facts = shading.describe(gbuffer, plan, self.engine)
            content, media_type = shading.encode(shade, gbuffer, self.engine, self.asked, facts)
        return Answer(content, media_type, facts, gbuffer.background.size, watch)

    def _memory(self, headers: list[exr.Header]) -> tuple[int, int]:
        """(bytes that the whole job needs, bytes that one prediction may use).

        Raises LimitError when the job would exceed the memory even with the smallest tiles.
        """
        bundle, per_pixel = self.engine.bundle, self.engine.bytes_per_pixel
        # any part may turn out to be the one that is shaded
        height, width = max((p.shape for header in headers for p in header.parts), key=prod)
        # Throughout: the files, their channels as float32 with masks, the answer and its copies.
        pixel = 4 * self.engine.channels + 4 + 12 * len(bundle.outputs)
        held = sum(header.body_bytes for header in headers) + pixel * width * height
        # First all channels as they are stored, then what the inputs may be derived from, and
        # after that, in the same room, the network.
        sources = 4 * self.engine.channels * width * height
        decoded = max(sources, sum(header.decoded_bytes for header in headers))
        multiple, halo = bundle.size_multiple, bundle.halo
        smallest = per_pixel * smallest_tile(height, width, multiple=multiple, halo=halo)
        least = held + max(decoded, smallest)
        if least > self.memory.total:
            raise LimitError("memory_bytes", least, self.memory.total)
        room = max(int(_SHARE * self.memory.total), least) - held
        tile_bytes = min(room, per_pixel * prod(padded(height, width, multiple)))
        return held + max(decoded, tile_bytes), tile_bytes
