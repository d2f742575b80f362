"""Sessions by name: whose publisher is here, who watches, and how it goes."""

from __future__ import annotations

import asyncio
import re
import secrets
import statistics
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from deepshade.tokens import same
from deepshade_service.config import Settings
from deepshade_service.live.answer import Answer
from deepshade_service.live.viewer import Viewer
from deepshade_service.problems import Problem

REST_AFTER = 0.2  # seconds without an answer, after which the picture rests
GRACE = 10.0  # seconds that a session waits for a publisher whose connection broke
_SPAN = 1.0  # seconds over which rates are taken

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(slots=True)
class Meter:
    """Events of the last second, and sums since the beginning."""

    answers: deque[tuple[float, float]] = field(default_factory=deque)  # when, age
    received: deque[tuple[float, int]] = field(default_factory=deque)  # when, bytes
    shaded: int = 0
    dropped: int = 0

    def answered(self, age: float) -> None:
        """An answer was made; its source's picture was `age` seconds old."""
        self.shaded += 1
        self.answers.append((time.monotonic(), age))

    def got(self, size: int) -> None:
        """A frame of so many bytes arrived."""
        self.received.append((time.monotonic(), size))

    def figures(self) -> dict[str, Any]:
        """For status messages; of the last second."""
        since = time.monotonic() - _SPAN
        for events in (self.answers, self.received):
            while events and events[0][0] < since:
                events.popleft()
        ages = [age for _, age in self.answers]
        return {
            "fps": round(len(ages) / _SPAN, 1),
            "age_ms": round(1e3 * statistics.median(ages), 1) if ages else None,
            "shaded": self.shaded,
            "dropped": self.dropped,
            "in_bytes_s": sum(size for _, size in self.received),
        }


class Session:
    """One stream. `resume` is the secret by which its publisher comes back."""

    def __init__(self, name: str, most_viewers: int) -> None:
        self.name = name
        self.resume = secrets.token_urlsafe(24)
        self.publisher = "here"
        self.meter = Meter()
        self.effects: list[str] = []
        self.plans: dict[str, Any] = {}
        self.viewers: set[Viewer] = set()
        self.last: Answer | None = None
        self.ended = asyncio.Event()
        self.replaced = asyncio.Event()  # of the publisher that is here: another one has come
        self._most = most_viewers
        self._resting: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def take(self, answer: Answer) -> None:
        """The newest answer."""
        self.meter.answered(time.time() - answer.made_at)
        answer.dropped = self.meter.dropped
        self.last, self.effects = answer, list(answer.shades)
        self.plans = {made.effect: made.plan for made in answer.made}

    async def show(self, answer: Answer) -> None:
        """To all viewers; those that are behind get it in place of an older one."""
        for viewer in list(self.viewers):
            await viewer.offer(answer, rest=answer.rest)
        if self._resting is not None:
            self._resting.cancel()
            self._resting = None
        if not answer.rest:
            loop = asyncio.get_running_loop()
            self._resting = loop.call_later(REST_AFTER, self._rest, answer)

    def add(self, viewer: Viewer) -> None:
        """Raises Problem 429 where there are as many as allowed."""
        if len(self.viewers) >= self._most:
            raise Problem(
                429,
                "too-many-viewers",
                f"{self._most} watch '{self.name}' already",
                fix="come back later, or start the service with more: --live-viewers",
            )
        self.viewers.add(viewer)

    def status(self, out_bytes_s: int) -> dict[str, Any]:
        """The message that everybody gets each second; who gets it says what is sent out."""
        size = self.last.size if self.last else None
        return {
            "type": "status",
            **self.meter.figures(),
            "viewers": len(self.viewers),
            "out_bytes_s": out_bytes_s,
            "publisher": self.publisher,
            "size": size,
            "full": self.last.full if self.last else None,
            "effects": self.effects,
        }

    def about(self) -> dict[str, Any]:
        """How answers are made: plans without what differs from frame to frame."""
        return {
            effect: {key: plan[key] for key in plan if key not in ("pixels", "memory_bytes")}
            for effect, plan in self.plans.items()
        }

    def end(self) -> None:
        """Nobody comes back."""
        self.publisher = "ended"
        if self._resting is not None:
            self._resting.cancel()
        self.ended.set()

    def _rest(self, answer: Answer) -> None:
        async def offer() -> None:
            for viewer in list(self.viewers):
                await viewer.offer(answer, rest=True)

        task = asyncio.get_running_loop().create_task(offer())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


class Sessions:
    """All sessions of a service."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._sessions: dict[str, Session] = {}
        self._leaving: dict[str, asyncio.TimerHandle] = {}

    def all(self) -> list[Session]:
        """By name."""
        return [self._sessions[name] for name in sorted(self._sessions)]

    def find(self, name: str) -> Session:
        """Raises Problem 404."""
        if name not in self._sessions:
            raise Problem(
                404,
                "no-session",
                f"there is no session '{name[:64]}'",
                fix="it begins when somebody publishes to it: deepshade-client stream … --live "
                f"{name[:64]}",
            )
        return self._sessions[name]

    def open(self, name: str, resume: object) -> Session:
        """A new session, or the one whose publisher has gone, or is who knows `resume`.

        Raises Problem 422 (no name of a session), 409 (it has a publisher), 429 (too many).
        """
        if not _NAME.fullmatch(name):
            raise Problem(
                422,
                "bad-parameter",
                f"'{name[:64]}' is no name of a session",
                fix="1 to 64 of A-Z a-z 0-9 _ . -, a letter or a digit first",
            )
        there = self._sessions.get(name)
        if there is not None:
            known = isinstance(resume, str) and same(resume, there.resume)
            if there.publisher == "here" and not known:
                raise Problem(
                    409,
                    "session-taken",
                    f"'{name}' has a publisher already",
                    fix="choose another name, or wait until it has ended",
                )
            self._stay(name)
            there.publisher = "here"
            there.replaced.set()
            there.replaced = asyncio.Event()
            return there
        if len(self._sessions) >= self._settings.live_sessions and self._leaving:
            self.end(self._sessions[next(iter(self._leaving))])  # gone for longest
        if len(self._sessions) >= self._settings.live_sessions:
            raise Problem(
                429,
                "too-many-sessions",
                f"{len(self._sessions)} sessions are live already",
                fix="come back later, or start the service with more: --live-sessions",
            )
        self._sessions[name] = Session(name, self._settings.live_viewers)
        return self._sessions[name]

    def leave(self, session: Session) -> None:
        """Its publisher has gone without saying that this is the end: it is waited for."""
        session.publisher = "gone"
        self._stay(session.name)
        loop = asyncio.get_running_loop()
        self._leaving[session.name] = loop.call_later(GRACE, self.end, session)

    def stop(self) -> None:
        """Forget all."""
        for session in self.all():
            self.end(session)

    def _stay(self, name: str) -> None:
        with suppress(KeyError):
            self._leaving.pop(name).cancel()

    def end(self, session: Session) -> None:
        """Its name is free."""
        self._stay(session.name)
        if self._sessions.get(session.name) is session:
            del self._sessions[session.name]
        session.end()
