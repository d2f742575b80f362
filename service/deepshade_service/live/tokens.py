"""Who may publish and who may watch: the operator's token, and short-lived ones of links."""

from __future__ import annotations

import base64
import hashlib
import hmac
import time
from collections.abc import Sequence

from starlette.requests import HTTPConnection

from deepshade.tokens import same
from deepshade_service.problems import Problem

LIFE = 3600.0  # seconds that a link is good for
_PROTOCOL_PREFIX = "token."


class Tokens:
    """Decides by a request's headers. Without a token everybody may: on loopback only.

    A link's token is "<expiry>.<HMAC-SHA256 of session and expiry>", with the operator's token as
    the key: nothing is stored, so a service that restarts knows the links it gave.
    """

    def __init__(self, token: str | None, *, beyond: bool = False) -> None:
        self._token = token
        self._closed = beyond and token is None

    def check(self, request: HTTPConnection) -> None:
        """Whether the request is the operator's, or a friend's. Raises Problem 401 and 403."""
        self._check(request, None)

    def check_viewer(self, request: HTTPConnection, session: str) -> None:
        """The same, or it has a link to the session. Raises Problem 401 and 403."""
        self._check(request, session)

    def link(self, session: str, now: float | None = None) -> tuple[str, int]:
        """(token, expiry in Unix seconds) for viewers of a session."""
        expiry = int((time.time() if now is None else now) + LIFE)
        return f"{expiry}.{self._signature(session, expiry)}", expiry

    def _check(self, request: HTTPConnection, session: str | None) -> None:
        if self._closed:
            raise Problem(
                403,
                "no-token",
                "live sessions are closed: others can reach the service, and it has no token",
                fix="start it with DEEPSHADE_TOKEN=<a long secret>, or bound to 127.0.0.1",
            )
        if self._token is None:
            return
        given = presented(request)
        if not any(self._valid(each, session) for each in given):
            raise Problem(
                401,
                "not-allowed",
                "the token is wrong or has expired" if given else "a token is needed",
                fix="send `Authorization: Bearer <DEEPSHADE_TOKEN>`, or get a new link",
                headers={"WWW-Authenticate": "Bearer"},
            )

    def _valid(self, given: str, session: str | None) -> bool:
        if same(given, self._token or ""):
            return True
        expiry, dot, signature = given.partition(".")
        if session is None or not dot or not expiry.isdecimal() or len(expiry) > 12:
            return False
        right = same(signature, self._signature(session, int(expiry)))
        return right and int(expiry) > time.time()

    def _signature(self, session: str, expiry: int) -> str:
        text = f"deepshade.live {session} {expiry}".encode()
        digest = hmac.digest((self._token or "").encode(), text, hashlib.sha256)
        return base64.urlsafe_b64encode(digest).decode().rstrip("=")


def presented(request: HTTPConnection) -> Sequence[str]:
    """The tokens that a request shows: in its header, or among a WebSocket's subprotocols."""
    kind, _, bearer = request.headers.get("authorization", "").partition(" ")
    found = [bearer.strip()] if kind.lower() == "bearer" and bearer.strip() else []
    offered = request.headers.get("sec-websocket-protocol", "").split(",")
    names = [name.strip() for name in offered]
    return found + [
        name.removeprefix(_PROTOCOL_PREFIX) for name in names if name.startswith(_PROTOCOL_PREFIX)
    ]
