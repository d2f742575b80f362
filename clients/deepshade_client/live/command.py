"""What `deepshade-client stream` does: a source, a publisher, sinks, and what is said meanwhile."""

from __future__ import annotations

import asyncio
import statistics
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from deepshade_client.batch import UsageError, views
from deepshade_client.exceptions import ClientError
from deepshade_client.live import sources, tev
from deepshade_client.live.files import Folder
from deepshade_client.live.pictures import LiveAnswer, Picture
from deepshade_client.live.publisher import Event, Publisher
from deepshade_client.live.streams import settings_of
from deepshade_client.request import Options
from deepshade_client.sequences import is_pattern

_SPAN = 2.0  # seconds over which the rate that is shown is taken


@dataclass(frozen=True, slots=True)
class Plan:
    """Where pictures come from and go to; see `deepshade-client stream --help`."""

    source: str
    out: str | None = None
    tev: str | None = None
    watch: bool = False
    rate: float | None = None
    loop: bool = False
    turntable: tuple[str, ...] | None = None

    def check(self, fps: float | None) -> None:
        """Raises UsageError for what doesn't go together."""
        if self.out is not None and fps is not None:
            raise UsageError(
                "files want every picture whole, and --fps makes pictures smaller to hold a rate",
                fix="leave out --fps, or --out",
            )
        if self.out is not None and self.loop:
            raise UsageError(
                "--loop never ends, and would write the same files", fix="leave it out"
            )
        if self.out is not None and not is_pattern(self.out) and self.out.endswith(".exr"):
            raise UsageError(
                f"--out {self.out} is one file for many pictures",
                fix="name a folder, or a pattern such as ao.####.exr",
            )


@dataclass(slots=True)
class Tally:
    """What came of a stream, and how it goes now."""

    answered: int = 0
    failed: int = 0
    sent_bytes: int = 0
    received_bytes: int = 0
    dropped: int = 0
    breaks: int = 0
    away: float = 0.0
    ages: list[float] = field(default_factory=list)
    recent: deque[float] = field(default_factory=deque)
    first: float | None = None
    last: float = 0.0

    def count(self, answer: LiveAnswer) -> None:
        """One more answer."""
        self.last = time.monotonic()
        self.first = self.last if self.first is None else self.first
        self.answered += 1
        self.sent_bytes += answer.sent_bytes
        self.received_bytes += answer.received_bytes
        self.dropped = answer.dropped
        if not answer.sharp:
            self.ages.append(answer.age)
            del self.ages[:-10_000]
        self.recent.append(self.last)
        while self.recent[0] < self.last - _SPAN:
            self.recent.popleft()

    @property
    def fps(self) -> float:
        """Answers a second, of the last two seconds."""
        long = min(_SPAN, self.last - (self.first or self.last))
        return len(self.recent) / long if long else 0.0

    def as_json(self) -> dict[str, Any]:
        """Of the whole stream."""
        seconds = self.last - (self.first or self.last)
        ages = sorted(self.ages)
        return {
            "answered": self.answered,
            "failed": self.failed,
            "dropped": self.dropped,
            "seconds": round(seconds, 3),
            "fps": round((self.answered - 1) / seconds, 2) if seconds else None,
            "age_ms": {
                "median": round(1e3 * statistics.median(ages), 1),
                "p95": round(1e3 * ages[int(0.95 * (len(ages) - 1))], 1),
            }
            if ages
            else None,
            "sent_bytes": self.sent_bytes,
            "received_bytes": self.received_bytes,
            "breaks": self.breaks,
            "away_seconds": round(self.away, 1),
        }


async def run(
    plan: Plan,
    server: str,
    session: str,
    effects: str,
    options: Options,
    *,
    quiet: bool,
    tally: Tally,
    **more: Any,
) -> None:
    """Stream until the source ends. Raises ClientError, OSError."""
    console = Console(stderr=True, highlight=False)
    told = _Teller(console, tally, quiet)
    every = plan.out is not None or (plan.rate is None and not _is_live(plan))
    publisher = Publisher(
        server, session, effects, settings_of(options), every=every, heard=told.heard, **more
    )
    feeding = asyncio.ensure_future(_feed(publisher, plan, options, told))
    folder = Folder(plan.out) if plan.out else None
    viewer = tev.Viewer(plan.tev, f"deepshade {session}") if plan.tev else None
    try:
        async for answer in publisher.answers():
            if answer.error is not None:
                tally.failed += 1
                told.failed(answer)
                continue
            tally.count(answer)
            if folder is not None:
                await asyncio.to_thread(folder.save, answer)
            if viewer is not None:
                await asyncio.to_thread(viewer.show, answer.planes)
            told.answered(answer)
        if feeding.done():
            feeding.result()
    finally:
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)
        if viewer is not None:
            viewer.close()
        told.close()


class _Teller:
    """Lines about what happens, and one on a terminal that says how it goes."""

    def __init__(self, console: Console, tally: Tally, quiet: bool) -> None:
        self._console, self._tally, self._quiet = console, tally, quiet
        self._status = console.status("") if console.is_terminal and not quiet else None
        if self._status is not None:
            self._status.start()
        self._errors: set[str] = set()

    def say(self, text: str) -> None:
        if not self._quiet:
            self._console.print(text, soft_wrap=True, markup=False)

    def heard(self, event: Event) -> None:
        if event.kind == "lost":
            self._tally.breaks += 1
        elif event.kind == "back":
            self._tally.away += float(event.facts["seconds"])
        if event.text:
            self.say(event.text)

    def answered(self, answer: LiveAnswer) -> None:
        if self._status is not None:
            tally = self._tally
            self._status.update(
                f"{tally.answered} answered, {tally.fps:.1f} a second, "
                f"{1e3 * answer.age:.0f} ms old, {tally.dropped} dropped, "
                f"{answer.sent_bytes / 1e6:.2f} MB sent each"
            )

    def failed(self, answer: LiveAnswer) -> None:
        assert answer.error is not None, "it failed"
        text = str(answer.error)
        if text not in self._errors and len(self._errors) < 20:  # the same of each is said once
            self._errors.add(text)
            self._console.print(f"{answer.picture.name or answer.id}: {text}", markup=False)
            if answer.error.fix:
                self._console.print(f"  {answer.error.fix}", markup=False)

    def close(self) -> None:
        if self._status is not None:
            self._status.stop()


def _is_live(plan: Plan) -> bool:
    """Whether pictures come when they come, and only the newest is of use."""
    return plan.watch or plan.source == "-" or plan.turntable is not None


async def _feed(publisher: Publisher, plan: Plan, options: Options, told: _Teller) -> None:
    try:
        async for picture in _pictures(publisher, plan, options, told):
            await publisher.offer(picture)
    finally:
        publisher.finish()


async def _pictures(
    publisher: Publisher, plan: Plan, options: Options, told: _Teller
) -> AsyncIterator[Picture]:
    if plan.turntable is not None:
        async for picture in _turntable(publisher, plan.turntable, told):
            yield picture
        return
    if plan.source == "-":
        async for picture in sources.piped(sys.stdin.buffer, told.say):
            yield picture
        return
    needs = await asyncio.shield(publisher.inputs)
    mapping: Mapping[str, str] | None = options.mapping
    read = sources.Reading(needs, mapping, options.profile)
    if plan.watch:
        folder = Path(plan.source)
        if not folder.is_dir():
            raise UsageError(f"there is no folder {folder} to watch", fix="make it first")
        async for picture in sources.watched(folder, read, told.say):
            yield picture
        return
    found = views([plan.source])
    async for picture in sources.sequence(found, read, rate=plan.rate, loop=plan.loop):
        yield picture


async def _turntable(
    publisher: Publisher, arguments: tuple[str, ...], told: _Teller
) -> AsyncIterator[Picture]:
    """What `deepshade turntable` writes, in a process of its own; it ends with this."""
    needs = await asyncio.shield(publisher.inputs)
    command = [sys.executable, "-m", "deepshade_workers.turntable", *arguments]
    command += ["--attributes", ",".join(needs)]
    process = await asyncio.to_thread(_started, command)
    try:
        async for picture in sources.piped(process.stdout, told.say):
            yield picture
        if await asyncio.to_thread(process.wait) != 0:
            raise ClientError("the turntable failed; what it said stands above")
    finally:
        if process.poll() is None:
            process.terminate()


def _started(command: list[str]) -> Any:
    import subprocess

    return subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
