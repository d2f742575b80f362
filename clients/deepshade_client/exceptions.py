"""Everything the client raises.

ClientError
├── TransportError             the request didn't get through
│   ├── ConnectionFailed         nothing answers at that address
│   ├── ConnectionBroken         it broke while a request was under way
│   └── TimedOut                 no answer within the time allowed
├── ServerProblem              the service answered with a problem document
│   ├── BadRequest               400, 404, 408, 413, 415, 422: the request has to change
│   │   ├── MissingAttribute       the picture lacks something the effect needs
│   │   └── TooLarge               413: over one of the service's limits
│   ├── Busy                     429: the queue is full
│   ├── NotReady                 503: models are still loading
│   └── ServerFailed             other 5xx
└── BadAnswer                  the answer is not what the service promises
"""

from __future__ import annotations

from typing import Any

from deepshade.errors import DeepshadeError


class ClientError(DeepshadeError):
    """The root of all errors here. `fix` says what to do about it, if anything is known."""


class TransportError(ClientError):
    """The request didn't get through."""

    exit_code = 3


class ConnectionFailed(TransportError):
    """Nothing answers at that address."""

    fix = "is the service running (deepshade serve), and is this its address (--server)?"


class ConnectionBroken(TransportError):
    """The connection broke while a request was under way: a restart, or something in between."""

    fix = "try again; if it happens every time, the service's log may say why"


class TimedOut(TransportError):
    """No answer within the time allowed."""

    fix = "allow more time (--timeout), or send smaller pictures"


class ServerProblem(ClientError):
    """The service's problem document (RFC 9457).

    `status` is the HTTP status, `kind` the end of the document's type ("missing-attribute"),
    `document` all of it, and `retry_after` the seconds that the service asks to wait, if it does.
    """

    def __init__(self, status: int, document: dict[str, Any], retry_after: float | None = None):
        detail = str(document.get("detail") or document.get("title") or f"HTTP {status}")
        super().__init__(detail, fix=str(document.get("fix", "")))
        self.status = status
        self.document = document
        self.kind = str(document.get("type", "")).rpartition(":")[2]
        self.retry_after = retry_after


class BadRequest(ServerProblem):
    """The request has to change before it can succeed."""


class MissingAttribute(BadRequest):
    """The picture lacks an attribute that the effect needs."""

    @property
    def missing(self) -> list[str]:
        """The attributes that were neither found nor derivable."""
        return list(self.document.get("missing", []))

    @property
    def found(self) -> list[str]:
        """The channels that the picture has."""
        return list(self.document.get("found", []))

    @property
    def near(self) -> dict[str, list[str]]:
        """For each missing attribute the channels whose names come near."""
        return dict(self.document.get("near", {}))


class TooLarge(BadRequest):
    """The picture exceeds a limit of the service."""


class Busy(ServerProblem):
    """The service's queue is full."""


class NotReady(ServerProblem):
    """The service has not loaded its models yet."""

    exit_code = 3


class ServerFailed(ServerProblem):
    """The service failed."""


class BadAnswer(ClientError):
    """The answer is not what the service promises; something in between may have altered it."""


def problem(status: int, document: dict[str, Any], retry_after: float | None) -> ServerProblem:
    """The exception for a problem document."""
    cls = _OF_STATUS.get(status, ServerFailed if status >= 500 else BadRequest)
    if str(document.get("type", "")).endswith(":missing-attribute"):
        cls = MissingAttribute
    return cls(status, document, retry_after)


_OF_STATUS: dict[int, type[ServerProblem]] = {413: TooLarge, 429: Busy, 503: NotReady}
