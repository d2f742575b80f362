"""Counts every response; plain ASGI, so that streaming bodies pass through untouched."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from deepshade_service.telemetry import Telemetry


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

        def count(status: int) -> None:
            # The route's pattern, not the path: strangers could make up endless labels.
            self._telemetry.answered(getattr(scope.get("route"), "path", "other"), status)

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                count(message["status"])
            await send(message)

        try:
            await self._app(scope, receive, counted)
        except Exception:
            count(500)  # answered further out
            raise
