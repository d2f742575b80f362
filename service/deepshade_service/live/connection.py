"""One WebSocket of a live session: its messages, its clock, and why it is refused."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Mapping
from typing import Any

from fastapi import WebSocket

from deepshade_service import problems
from deepshade_service.problems import Problem

PROTOCOL = "deepshade.live.1"
_MAX_TEXT = 2**16
_PINGS = (0.0, 0.3, 0.6)  # seconds after the beginning; then one each
_PING = 5.0


class Connection:
    """Messages in and out. `ahead` is by how much the other's clock is, None where unknown."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._soonest = float("inf")
        self.ahead: float | None = None

    async def open(self) -> None:
        """Accept it, in our subprotocol if that is offered."""
        offered = self._socket.scope.get("subprotocols", [])
        await self._socket.accept(subprotocol=PROTOCOL if PROTOCOL in offered else None)

    async def say(self, message: Mapping[str, Any]) -> None:
        """Send a text message."""
        await self._socket.send_text(json.dumps(message, separators=(",", ":")))

    async def send(self, message: bytes) -> None:
        """Send a binary message."""
        await self._socket.send_bytes(message)

    async def refuse(self, problem: Problem) -> None:
        """Say why not, and close."""
        await self.say({"type": "problem", "problem": problems.document(problem)})
        await self._socket.close(4000 + problem.status)

    async def close(self, code: int) -> None:
        """Close it."""
        await self._socket.close(code)

    async def messages(self) -> AsyncIterator[dict[str, Any] | bytes]:
        """What the other says until it leaves; pings and pongs are dealt with here.

        Raises Problem 422 for a text that is no object with a type.
        """
        while True:
            message = await self._socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if (data := message.get("bytes")) is not None:
                yield data
                continue
            said = _read(message.get("text") or "")
            if said["type"] == "ping":
                await self.say({"type": "pong", "t": said.get("t"), "clock": time.time()})
            elif said["type"] == "pong":
                self._pong(said)
            else:
                yield said

    async def compare_clocks(self) -> None:
        """Ping for ever: soon at first, then now and then."""
        for pause in _PINGS:
            await asyncio.sleep(pause)
            await self.say({"type": "ping", "t": time.time()})
        while True:
            await asyncio.sleep(_PING)
            await self.say({"type": "ping", "t": time.time()})

    def _pong(self, said: Mapping[str, Any]) -> None:
        sent, clock, now = said.get("t"), said.get("clock"), time.time()
        if isinstance(sent, float) and isinstance(clock, int | float) and 0 <= now - sent < 60:
            # a little worse than the best counts too, or clocks that drift would never be heard
            if now - sent <= 1.2 * self._soonest:
                self.ahead = clock - (sent + now) / 2
            self._soonest = min(self._soonest, now - sent)


def _read(text: str) -> dict[str, Any]:
    try:
        if len(text) > _MAX_TEXT:
            raise ValueError
        said = json.loads(text)
        if isinstance(said, dict) and isinstance(said.get("type"), str):
            return said
    except (ValueError, RecursionError):
        pass
    raise Problem(
        422,
        "bad-message",
        f"a text message must be a JSON object with a type, not {text[:60]!r}",
        fix="docs/streaming.md lists the messages",
    )
