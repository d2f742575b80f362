"""A publisher's frames on their way: decoding n + 1, inferring n and encoding n - 1 overlap.

One frame is inferred, one is decoded and waits, and one may be pending: a newer one takes its
place. Its publisher is told when to send (`next`), so that what is sent is seldom in vain.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from math import prod
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, live
from deepshade.effects import SETTINGS
from deepshade.errors import DeepshadeError
from deepshade.gbuffer import GBuffer, load_gbuffer
from deepshade.gbuffer.conventions import Conventions
from deepshade.gbuffer.plan import plan_gbuffer
from deepshade_service import problems
from deepshade_service.answers import Made
from deepshade_service.decoding import decode, read_headers, stored
from deepshade_service.live.answer import Answer, Want
from deepshade_service.live.asking import Asking, Reader
from deepshade_service.live.history import History
from deepshade_service.live.session import Session
from deepshade_service.live.trust import Trust
from deepshade_service.live.viewer import Outlet
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.shading import Job, Shader, run
from deepshade_service.telemetry import Stopwatch, Telemetry
from deepshade_service.workers import Cancelled, end

log = logging.getLogger("deepshade.service")

T = TypeVar("T")
Float = NDArray[np.float32]
Say = Callable[[dict[str, Any]], Awaitable[None]]

_SHARP_TILE = 2**20  # pixels; a sharp picture is given up between tiles when a new frame comes


@dataclass(frozen=True, slots=True)
class _Picture:
    """A frame's planes, as the loader of G-buffers takes files."""

    data: exr.Planes
    name: str = ""


@dataclass(slots=True)
class _Work:
    """A decoded frame; `held` releases the memory that it takes."""

    frame: live.Frame
    made_at: float
    asking: Asking
    parameters: ShadeParameters
    headers: list[exr.Header]
    jobs: list[Job]
    gbuffers: list[GBuffer]
    held: int
    room: AsyncExitStack
    motion: Float | None = None
    took_ms: dict[str, float] = field(default_factory=dict)

    @property
    def rest(self) -> bool:
        return bool(self.frame.flags & live.REST)


@dataclass(frozen=True, slots=True)
class _Told:
    """Why there is no answer to a frame; None where a newer one came."""

    id: int
    problem: Problem | None


class Pipeline:
    """Shades what `offer` is given, and hands answers to the publisher's outlet and the session."""

    def __init__(
        self,
        shader: Shader,
        telemetry: Telemetry,
        session: Session,
        reader: Reader,
        say: Say,
        outlet: Outlet,
        want: Want | None,
        history: History | None,
    ) -> None:
        self._shader, self._telemetry, self._session = shader, telemetry, session
        self._reader, self._say, self._outlet, self._want = reader, say, outlet, want
        self._history = history
        self._pending: tuple[live.Frame, float] | None = None
        self._arrived = asyncio.Event()
        self._decoded: asyncio.Queue[_Work | _Told] = asyncio.Queue(1)
        self._trust = Trust()
        self._about: dict[str, Any] = {}
        self._granted = False
        self._decoding = self._inferring = False
        self._settled: tuple[Asking, float] | None = None

    def offer(self, frame: live.Frame, made_at: float) -> None:
        """The newest frame; `made_at` is when its source made it, by our clock."""
        self._session.meter.dropped += self._pending is not None
        self._pending = frame, made_at
        self._granted = False
        self._arrived.set()

    async def run(self) -> None:
        """Shade until cancelled."""
        await self._grant()
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._decode_all())
                group.create_task(self._infer_all())
                if self._want is not None:
                    group.create_task(self._outlet.run())
        finally:
            if not self._decoded.empty() and isinstance(work := self._decoded.get_nowait(), _Work):
                await work.room.aclose()

    async def _grant(self) -> None:
        if not self._granted:
            self._granted = True
            await self._say({"type": "next"})

    async def _decode_all(self) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            assert self._pending is not None, "it has arrived"
            (frame, made_at), self._pending = self._pending, None
            if not self._inferring and self._decoded.empty():
                await self._grant()  # the link is what takes time: the next may set out
            self._decoding = True
            await self._decoded.put(await self._or_told(frame, self._decode(frame, made_at)))
            self._decoding = False

    async def _infer_all(self) -> None:
        while True:
            self._inferring = False
            work = await self._decoded.get()
            self._inferring = True
            if self._pending is None and not self._decoding:  # else one more would only age
                await self._grant()
            answer: Answer | _Told = work if isinstance(work, _Told) else await self._answer(work)
            if isinstance(answer, _Told):
                if answer.problem is not None:
                    if self._want is not None:
                        await self._outlet.idle()  # answers to frames before it come first
                    await self._say(
                        {
                            "type": "problem",
                            "id": answer.id,
                            "problem": problems.document(answer.problem),
                        }
                    )
                continue
            for made in answer.made:
                nonfinite = int(made.facts["nonfinite_pixels"])
                stages = {**made.milliseconds}
                self._telemetry.shaded(made.effect, stages, made.pixels, made.computed, nonfinite)
            self._session.take(answer)
            if (about := self._session.about()) != self._about:
                self._about = about
                await self._say({"type": "about", "effects": about})
            if self._want is not None:
                await self._outlet.offer(answer, self._want)
            await self._session.show(answer)

    async def _answer(self, work: _Work) -> Answer | _Told:
        async with work.room:
            return await self._or_told(work.frame, self._unless_newer(work))

    async def _or_told(self, frame: live.Frame, work: Awaitable[T]) -> T | _Told:
        """What the work gives, or what the publisher is told of it, in the order of its frames."""
        try:
            return await work
        except Cancelled:
            return _Told(frame.id, None)
        except Problem as error:
            problem = error
        except DeepshadeError as error:
            problem = problems.from_error(error, ShadeParameters.model_fields)
        except Exception:
            log.exception("frame %d of session %s", frame.id, self._session.name)
            problem = Problem(500, "internal", "the service failed on this frame; its log says how")
        return _Told(frame.id, problem)

    async def _decode(self, frame: live.Frame, made_at: float) -> _Work:
        watch, shader = Stopwatch(), self._shader
        asking = self._reader.read(frame.about)
        asked = self._steady(asking, frame)

        def unpack(_: threading.Event) -> tuple[_Picture, list[exr.Header]]:
            with watch.time("unpack"):
                picture = _Picture(frame.picture())
                return picture, read_headers([picture], asked, shader.limits)

        def load(_: threading.Event) -> tuple[list[GBuffer], Float | None]:
            with watch.time("decode"):
                bundles = [job.bundle for job in jobs]
                gbuffers = self._trust.load(
                    (frame.about["planes"], asking),
                    asked,
                    lambda how: list(decode([picture], headers, bundles, how, shader.limits)),
                )
                motion = None if self._history is None else _motion(picture, headers, asked)
                return gbuffers, motion

        picture, headers = await shader.workers.run(unpack)
        jobs = await shader.jobs(headers, asked, asking.candidates)
        held = max(job.need.total for job in jobs)
        room = AsyncExitStack()
        await room.enter_async_context(shader.memory.hold(held))
        try:
            gbuffers, motion = await shader.workers.run(load)
        except BaseException:
            await room.aclose()
            raise
        took = watch.milliseconds
        read = headers, jobs, gbuffers
        return _Work(frame, made_at, asking, asked, *read, held, room, motion, took)

    def _steady(self, asking: Asking, frame: live.Frame) -> ShadeParameters:
        """The settings, with the radius of the stream's first frame where none is asked for.

        Else it would follow each frame's depths, and what it reaches would flicker.
        """
        if self._settled is None or self._settled[0] is not asking or frame.flags & live.CUT:
            self._settled = None
            return asking.parameters
        return asking.parameters.model_copy(update={"radius": self._settled[1]})

    async def _unless_newer(self, work: _Work) -> Answer:
        """The answer; a sharp picture is given up as soon as a new frame has arrived."""
        if not work.rest:
            return await self._infer(work)
        task = asyncio.create_task(self._infer(work))
        newer = asyncio.create_task(self._arrived.wait())
        try:
            await asyncio.wait({task, newer}, return_when=asyncio.FIRST_COMPLETED)
            if not task.done():
                self._session.meter.dropped += 1
                raise Cancelled
            return task.result()
        finally:
            await end(task, newer)

    async def _infer(self, work: _Work) -> Answer:
        frame = work.frame

        def infer(cancelled: threading.Event) -> Answer:
            shades, made = {}, []
            for job, gbuffer in zip(work.jobs, work.gbuffers, strict=True):
                if cancelled.is_set():
                    raise Cancelled
                if work.rest:
                    most = min(job.need.max_pixels, _SHARP_TILE)
                    job = replace(job, need=replace(job.need, max_pixels=most))
                shade, how = run(job, gbuffer, work.headers, work.parameters, work.held, cancelled)
                if self._history is not None:
                    alone = work.rest or bool(frame.flags & live.CUT)
                    shade = self._history.blend(
                        job.bundle.effect, shade, gbuffer, work.motion, alone=alone
                    )
                shades[job.bundle.effect] = shade
                made.append(how)
            took = dict(work.took_ms)
            for how in made:
                for stage, ms in how.milliseconds.items():
                    took[stage] = took.get(stage, 0.0) + ms
            full = _full(frame)
            return Answer(frame.id, shades, made, work.made_at, full, took, work.rest)

        answer = await self._shader.workers.run(infer)
        self._settle(work, answer.made)
        return answer

    def _settle(self, work: _Work, made: Sequence[Made]) -> None:
        if self._settled is not None:
            return
        found = [how.plan["radius"] for how in made if how.plan.get("radius_source") == "depth"]
        if found:
            self._settled = work.asking, found[0]


def _motion(
    picture: _Picture, headers: Sequence[exr.Header], asked: ShadeParameters
) -> Float | None:
    """(2, H, W): by how many pixels surfaces moved since the frame before; None if it isn't there.

    A picture's motion is that of its open shutter, which is so many frames.
    """
    profile, mapping = asked.profile, asked.mapping
    plan = plan_gbuffer(headers, [""], ["motion"], profile=profile, mapping=mapping)
    if "motion" not in plan.choices:
        return None
    gbuffer = load_gbuffer(
        ("", picture.data),
        ["motion"],
        headers=headers,
        conventions=Conventions(checks="trust"),
        profile=profile,
        mapping=mapping,
    )
    shutter = stored(gbuffer, SETTINGS["shutter"]) or 1.0
    return gbuffer.attributes["motion"] / np.float32(shutter)


def _full(frame: live.Frame) -> tuple[int, int]:
    said = frame.about.get("full")
    if (
        isinstance(said, list)
        and len(said) == 2
        and all(type(side) is int and 0 < side < 2**16 for side in said)
        and prod(said) >= frame.width * frame.height
    ):
        return said[0], said[1]
    return frame.width, frame.height


def source_time(frame: live.Frame, clock: float | None) -> float:
    """When its source made a frame, by our clock; `clock` is by how much the sender's is ahead.

    Where that isn't known, or would be in the future: now.
    """
    now = time.time()
    return now if clock is None else min(now, frame.time - clock)
