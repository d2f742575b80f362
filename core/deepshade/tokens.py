"""Who may call what changes something: a bearer token, or without one this machine alone.

Plain ASGI, for any of our services, so that no route can be forgotten.
"""

from __future__ import annotations

import hmac
import json
import os
import re
from collections.abc import Awaitable, Callable, MutableMapping
from hashlib import sha256
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from deepshade.errors import ConfigError
from deepshade.problems import MEDIA_TYPE, type_uri

VARIABLE = "DEEPSHADE_TOKEN"
_TOKEN = re.compile(r"[\w.~-]{16,256}", re.ASCII)

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


def configured() -> str | None:
    """The token of $DEEPSHADE_TOKEN; None without. Raises ConfigError for one that is none."""
    token = os.environ.get(VARIABLE) or None
    if token is not None and not _TOKEN.fullmatch(token):
        raise ConfigError(
            VARIABLE,
            detail=f"${VARIABLE} must be 16 to 256 letters, digits or - . _ ~, as of "
            "'openssl rand -hex 32'",
        )
    return token


def same(given: str, token: str) -> bool:
    """Whether they are equal, in a time that doesn't tell how much of them is."""
    pair = (sha256(each.encode()).digest() for each in (given, token))
    return hmac.compare_digest(*pair)


def is_loopback(host: str) -> bool:
    """Whether a host's name or address is this machine's own, and never another's."""
    host = host.strip("[]").lower()
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


class TokenGuard:
    """ASGI middleware. With a token, whoever lacks it gets a 401 from what is `guarded`.

    Without one, requests must be made to a loopback name, or they get a 403: a web page that makes
    its own name mean 127.0.0.1 still sends that name. Pages of other origins get one either way.
    `guarded` is asked with a method and a path.
    """

    def __init__(self, app: App, token: str | None, guarded: Callable[[str, str], bool]) -> None:
        self._app, self._token, self._guarded = app, token, guarded

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] == "http" and self._guarded(scope["method"], scope["path"]):
            headers = {k.lower(): v.decode("latin-1") for k, v in reversed(scope["headers"])}
            if refusal := self._refused(headers):
                await _answer(send, *refusal)
                return
        await self._app(scope, receive, send)

    def _refused(self, headers: dict[bytes, str]) -> tuple[int, str, str, str] | None:
        host, origin = headers.get(b"host", ""), headers.get(b"origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            detail = f"pages of {origin[:100]} may not do this"
            return 403, "other-origin", detail, "ask from a program, or from a page of this service"
        if self._token is None:
            if is_loopback(urlsplit(f"//{host}").hostname or ""):
                return None
            fix = f"set ${VARIABLE} to the same token on both sides"
            return 403, "no-token", "without a token this is for this machine alone", fix
        kind, _, given = headers.get(b"authorization", "").partition(" ")
        if kind.lower() == "bearer" and same(given.strip(), self._token):
            return None
        fix = f"send 'Authorization: Bearer <token>'; our commands send ${VARIABLE}"
        return 401, "no-token", "this needs the service's token", fix


async def _answer(send: Send, status: int, kind: str, detail: str, fix: str) -> None:
    titles = {401: "Unauthorized", 403: "Forbidden"}
    document = {"type": type_uri(kind), "title": titles[status], "status": status}
    body = json.dumps({**document, "detail": detail, "fix": fix}).encode()
    headers = [(b"content-type", MEDIA_TYPE.encode()), (b"content-length", b"%d" % len(body))]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
