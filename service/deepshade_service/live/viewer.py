"""Somebody who watches: gets the newest answer whenever the one before has arrived."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

from deepshade import live
from deepshade_service.live.answer import Answer, Want
from deepshade_service.problems import Problem

_WINDOW = 2  # answers on their way to one viewer
_PATIENCE = 2.0  # seconds after which one that isn't acknowledged no longer counts
MOVING, REST = "jpeg", "deflate"

Send = Callable[[bytes], Awaitable[None]]


class Outlet:
    """Sends answers to one connection: the newest wins, unless `every` is wanted.

    `window` bounds what is on its way by acknowledgements; None leaves that to the connection.
    """

    def __init__(self, send: Send, *, every: bool = False, window: int | None = _WINDOW) -> None:
        self._send = send
        self._every = every
        self._window = window
        self._next: tuple[Answer, Want] | None = None
        self._changed = asyncio.Event()
        self._under_way: dict[int, float] = {}
        self._busy = False
        self.sent_bytes = 0
        self.overwritten = 0

    async def offer(self, answer: Answer, want: Want) -> None:
        """Send this next. With `every` it waits until there is room, else it overwrites."""
        while self._every and self._next is not None:
            await self._turn()
        self.overwritten += self._next is not None
        self._next = answer, want
        self._changed.set()

    async def idle(self) -> None:
        """Returns when nothing waits and nothing is being sent."""
        while self._next is not None or self._busy:
            await self._turn()

    def acknowledge(self, id: object) -> None:
        """That answer has arrived, and so have those before it."""
        if isinstance(id, int):
            for each in [each for each in self._under_way if each <= id]:
                del self._under_way[each]
            self._changed.set()

    async def run(self) -> None:
        """Send for ever."""
        while True:
            while self._next is None or self._full():
                await self._turn(_PATIENCE if self._next else None)
            (answer, want), self._next = self._next, None
            self._busy = True
            self._changed.set()
            message = await answer.message(want)
            if self._window is not None:
                self._under_way[answer.id] = asyncio.get_running_loop().time()
            await self._send(message)
            self.sent_bytes += len(message)
            self._busy = False
            self._changed.set()

    def _full(self) -> bool:
        if self._window is None:
            return False
        late = asyncio.get_running_loop().time() - _PATIENCE
        return sum(at > late for at in self._under_way.values()) >= self._window

    async def _turn(self, seconds: float | None = None) -> None:
        self._changed.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._changed.wait()


class Viewer:
    """A viewer's wishes, and its outlet."""

    def __init__(self, send: Send) -> None:
        self.outlet = Outlet(send)
        self.moving = Want(MOVING)
        self.resting = Want(REST, rest=True)

    def want(self, said: Mapping[str, Any]) -> None:
        """Takes a "want" message. Raises Problem 422."""
        names = (*live.available(), *live.PICTURES, "none")
        moving, rest = said.get("moving", self.moving.codec), said.get("rest", self.resting.codec)
        shows = said.get("shows", self.moving.shows)
        if moving not in names or rest not in names or not isinstance(shows, str):
            raise Problem(
                422,
                "bad-parameter",
                f'"moving" and "rest" must each be one of {", ".join(names)}, "shows" an effect',
            )
        self.moving = Want(moving, shows=shows[:40])
        self.resting = Want(rest, shows=shows[:40], rest=True)

    async def offer(self, answer: Answer, *, rest: bool) -> None:
        """Send it, as far as it is wanted."""
        want = self.resting if rest else self.moving
        if want.codec != "none":
            await self.outlet.offer(answer, want)
