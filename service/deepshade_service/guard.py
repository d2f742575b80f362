"""Whom browsers may act for: Host and Origin checks, of requests and of WebSockets alike.

A stranger's page can reach a service on its reader's machine or network in two ways. It can send
requests across origins: browsers withhold the answer, but a form is sent without asking, and a
WebSocket isn't held back at all. Or its name is made to resolve to this address (DNS rebinding),
and to the browser both are one origin. Against the first the Origin is checked, against the second
the Host. Programs other than browsers send no Origin and are not affected.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection
from functools import cache
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send

from deepshade_service.problems import Problem, respond

ANY = "*"
# They change nothing, and without CORS headers a browser shows nobody the answer.
_SAFE = ("GET", "HEAD", "OPTIONS")
_PORTS = {"http": 80, "https": 443}


class Guard:
    """Refuses requests and WebSockets whose Host isn't ours, or whose Origin is another's.

    Ours are addresses, names without a dot (no public DNS has them), this machine's own name, and
    `hosts`; ".example.com" is every name below it, "*" any. Pages of the Host itself and of
    `origins` ("https://example.com", "*" any) may send what they like.
    """

    def __init__(
        self, app: ASGIApp, hosts: Collection[str] = (), origins: Collection[str] = ()
    ) -> None:
        self._app = app
        self._hosts = {host.lower().rstrip(".") for host in hosts}
        self._origins = {origin.lower().rstrip("/") for origin in origins}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass it on, or answer what is wrong with it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        problem = self._problem(scope)
        if problem is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await respond(problem)(scope, receive, send)
        else:
            await _deny(problem, scope, receive, send)

    def _problem(self, scope: Scope) -> Problem | None:
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) > 1 or len(origins) > 1:
            return Problem(400, "bad-header", "there are several Host or Origin headers")
        host = hosts[0] if hosts else None
        if host is not None and not self._is_ours(host):
            name = _split(host)[0] or host
            return Problem(
                421,
                "unknown-host",
                f"this service doesn't go by the name '{name[:100]}'",
                fix=f"ask for it by its address, or start it with --allow-host {name[:100]}",
            )
        harmless = scope["type"] == "http" and scope["method"] in _SAFE
        if not origins or harmless or self._is_friendly(origins[0], host):
            return None
        origin = origins[0][:100]
        return Problem(
            403,
            "foreign-origin",
            f"a page of '{origin}' may not use this service",
            fix=f"if it should, start the service with --allow-origin {origin}",
        )

    def _is_ours(self, host: str) -> bool:
        name, _ = _split(host)
        if name is None:
            return False
        if ANY in self._hosts or name in self._hosts or _is_address(name) or "." not in name:
            return True
        below = any(one.startswith(".") and name.endswith(one) for one in self._hosts)
        return below or name in _own_names()

    def _is_friendly(self, origin: str, host: str | None) -> bool:
        origin = origin.lower()
        if ANY in self._origins or origin.rstrip("/") in self._origins:
            return True
        # Not the scheme: a proxy may end TLS before us.
        scheme, _, authority = origin.partition("://")
        name, port = _split(host or "")
        theirs, other = _split(authority)
        usual = _PORTS.get(scheme)
        return name is not None and (name, port or usual) == (theirs, other or usual)


def cross_origin(app: Starlette, origins: Collection[str]) -> None:
    """Let the pages of `origins` read the answers, headers included, that they may ask for."""
    if origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=[origin.lower().rstrip("/") for origin in origins],
            allow_methods=[ANY],
            allow_headers=[ANY],
            expose_headers=[ANY],
        )


async def _deny(problem: Problem, scope: Scope, receive: Receive, send: Send) -> None:
    """End a WebSocket before it exists: by a problem document, where the server can send one."""
    await receive()  # its request to connect
    if "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": problem.detail[:100]})
        return
    response = respond(problem)
    start = {"status": response.status_code, "headers": response.raw_headers}
    await send({"type": "websocket.http.response.start", **start})
    await send({"type": "websocket.http.response.body", "body": bytes(response.body)})


def _split(host: str) -> tuple[str | None, int | None]:
    """A Host header's name, lower case, and port; (None, None) for what is none."""
    try:
        parts = urlsplit(f"//{host}")
        name, port = parts.hostname, parts.port
    except ValueError:
        return None, None
    if not name or parts.path or parts.query or parts.fragment or "@" in host:
        return None, None
    return name.rstrip("."), port


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name == "localhost" or name.endswith(".localhost")
    return True


@cache
def _own_names() -> frozenset[str]:
    """What this machine calls itself."""
    return frozenset(name.lower().rstrip(".") for name in (socket.gethostname(), socket.getfqdn()))
