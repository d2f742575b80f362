"""One request's work from bytes to bytes, timed, and within its part of the memory."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import prod
from typing import TYPE_CHECKING

from deepshade import exr
from deepshade.effects import EFFECTS
from deepshade.engines import Engine
from deepshade.machine import trim
from deepshade.threads import busy
from deepshade_service import shading
from deepshade_service.choice import Choice, Choices
from deepshade_service.memory import MemoryBudget
from deepshade_service.planner import Plan, Scene, explain
from deepshade_service.pool import Cancelled
from deepshade_service.room import Room, bytes_per_pixel, room_for, size_of
from deepshade_service.telemetry import Stopwatch
from deepshade_service.uploads import Upload

if TYPE_CHECKING:
    from deepshade_service.candidate import Candidate

# Work that used more hands memory back at once, other work when the service is idle.
_BIG = 512 * 2**20
# How much more memory for each pixel the engine that is chosen in the end may take.
_SPARE = 4


@dataclass(frozen=True, slots=True)
class Answer:
    """An encoded picture, or a plan as JSON, and how it was made."""

    content: bytes
    media_type: str
    facts: shading.Facts
    pixels: int
    computed: int
    watch: Stopwatch


@dataclass(frozen=True, slots=True)
class Job:
    """What one request asks for; call it on a worker thread.

    `choices` is what the request leaves open of bundle and backend, `load` gives an engine.
    """

    choices: Choices
    load: Callable[[Candidate], Engine]
    files: list[Upload]
    limits: exr.Limits
    memory: MemoryBudget

    def __call__(self, cancelled: threading.Event) -> Answer:
        """Shade the picture. Raises what its steps raise, and Cancelled."""
        watch = Stopwatch()
        with watch.time("decode"):
            headers = [exr.read_header(file.data, self.limits) for file in self.files]
        choice = self._first(headers)
        engine = self.load(choice.candidate)
        spare = _SPARE if self.choices.open else 1
        room = room_for(headers, engine, self.memory.total, spare=spare)
        with self.memory.hold(room.needed, cancelled):
            if cancelled.is_set():
                raise Cancelled
            try:
                with busy():
                    return self._shade(headers, choice, engine, room, watch, cancelled)
            finally:
                if room.needed > _BIG:
                    engine.shrink()
                    trim()

    def _first(self, headers: list[exr.Header]) -> Choice:
        """The choice before anything is decoded: all of the picture may have to be computed."""
        return self.choices.first(prod(size_of(headers)))

    def _shade(
        self,
        headers: list[exr.Header],
        choice: Choice,
        engine: Engine,
        room: Room,
        watch: Stopwatch,
        cancelled: threading.Event,
    ) -> Answer:
        asked = self.choices.asked
        with watch.time("decode"):
            gbuffer = shading.decode(self.files, headers, engine.bundle, asked, self.limits)
        with watch.time("plan"):
            scene = Scene(gbuffer, EFFECTS[engine.bundle.effect])
            if self.choices.open:
                choice, engine = self._final(scene, choice, engine, room)
            plan = scene.plan(engine.bundle, asked, room.max_pixels(engine))
            made = explain(scene, plan, choice, self.choices, engine, room, headers)
            facts = shading.describe(gbuffer, plan, engine, made)
        if asked.explain:
            content = json.dumps(made, indent=2).encode()
            return Answer(content, "application/json", facts, 0, 0, watch)
        with watch.time("infer"):
            shade = shading.infer(gbuffer, plan, engine, cancelled, consume=True)
        with watch.time("encode"):
            content, media_type = shading.encode(shade, gbuffer, asked, facts, made)
        return Answer(content, media_type, facts, gbuffer.background.size, plan.computed, watch)

    def _final(
        self, scene: Scene, choice: Choice, engine: Engine, room: Room
    ) -> tuple[Choice, Engine]:
        """The choice again, now that it is known what has to be computed.

        Among those whose inputs have been decoded. One whose tiles exceed the memory that is held
        doesn't come into question; then the first choice stays, for which it was held.
        """
        asked = self.choices.asked
        plans: dict[str, Plan] = {}

        def pixels(candidate: Candidate) -> int:
            bundle = candidate.bundle
            if bundle.name not in plans:
                plans[bundle.name] = scene.plan(bundle, asked, room.max_pixels(engine))
            return plans[bundle.name].computed

        decoded = set(scene.gbuffer.attributes)
        pool = tuple(c for c in self.choices.pool if decoded.issuperset(c.bundle.inputs))
        final = replace(self.choices, pool=pool).final(pixels)
        if final.candidate is choice.candidate:
            return final, engine
        other = self.load(final.candidate)
        tiles = scene.plan(other.bundle, asked, room.max_pixels(other)).tiling
        largest = max((prod(tile.shape) for tile in tiles), default=0)
        if largest * bytes_per_pixel(other) > room.tile_bytes:
            reason = f"{choice.reason} that fits the memory ({other.bundle.name} doesn't)"
            return Choice(choice.candidate, reason), engine
        return final, other
