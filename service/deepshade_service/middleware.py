"""Plain ASGI around the application, so that streaming bodies pass through untouched."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepshade_service.telemetry import Telemetry

# A refused body is thrown away for so long, in seconds, before its connection is closed.
_MAX_LINGER = 1.0


class Counting:
    """Tells the telemetry the route and status of each response."""

    def __init__(self, app: ASGIApp, telemetry: Telemetry) -> None:
        self._app = app
        self._telemetry = telemetry

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        status = 0

        async def seen(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, seen)
        except Exception:
            status = status or 500  # answered further out, unless an answer had begun
            raise
        finally:
            # The route's pattern, not the path: strangers could make up endless labels.
            if status:
                self._telemetry.answered(getattr(scope.get("route"), "path", "other"), status)


class Closing:
    """Closes the connection of a request that is answered before its body has arrived.

    Kept alive, the connection would first have to carry the rest of a body that nobody wants,
    and the client would see the refusal only after that or a timeout. Closed at once, the unread
    bytes would make the system reset it, and the client might lose the refusal. So the answer
    goes out, what still arrives is thrown away for a moment, and then the connection is closed.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        headers = dict(scope.get("headers", ()))
        has_body = b"transfer-encoding" in headers or headers.get(b"content-length", b"0") != b"0"
        if scope["type"] != "http" or not has_body:
            await self._app(scope, receive, send)
            return
        arriving, refused = True, False

        async def received() -> Message:
            nonlocal arriving
            message = await receive()
            arriving = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def drain() -> None:
            while arriving:
                await received()

        async def sent(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and arriving:
                # waiting once more for a body that was too slow, or for one that its client holds
                # back until it is asked for, would be in vain
                refused = message["status"] != 408 and b"expect" not in headers
                others = [h for h in message["headers"] if h[0].lower() != b"connection"]
                message = {**message, "headers": [*others, (b"connection", b"close")]}
            elif refused and not message.get("more_body", False):
                await send({**message, "more_body": True})
                with suppress(TimeoutError):
                    async with asyncio.timeout(_MAX_LINGER):
                        await drain()
                message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        await self._app(scope, received, sent)
