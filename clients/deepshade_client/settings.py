"""Small value objects for a client's settings."""

from __future__ import annotations

import math
import os
import random
from dataclasses import dataclass

import httpx

from deepshade_client.exceptions import (
    Busy,
    ClientError,
    ConnectionBroken,
    ConnectionFailed,
    NotReady,
)

_WORTH_RETRYING = (ConnectionFailed, ConnectionBroken, Busy, NotReady)
MAX_RETRY_AFTER = 300.0  # seconds; the service asks for a minute at most, a proxy may for a day

DEFAULT_SERVER = "http://127.0.0.1:8000"


def default_server() -> str:
    """The address in $DEEPSHADE_SERVER, else this machine's port 8000."""
    return os.environ.get("DEEPSHADE_SERVER") or DEFAULT_SERVER


@dataclass(frozen=True, slots=True)
class Timeout:
    """Seconds to wait: for a connection, for each piece sent, and for the answer to begin.

    A picture may wait in the service's queue, so `answer` is long.
    """

    connect: float = 5.0
    send: float = 60.0
    answer: float = 600.0

    @classmethod
    def of(cls, given: Timeout | float | None) -> Timeout:
        """Itself; a number is the seconds until the answer; None are the defaults.

        Raises ClientError for what is neither.
        """
        if given is None or isinstance(given, Timeout):
            return given or cls()
        if not (isinstance(given, int | float) and 0 < given < math.inf):
            raise ClientError(f"a timeout is seconds above 0 or a Timeout, not {given!r}")
        return cls(answer=given)

    def as_httpx(self) -> httpx.Timeout:
        """The same for httpx."""
        return httpx.Timeout(
            connect=self.connect, write=self.send, read=self.answer, pool=self.answer
        )


@dataclass(frozen=True, slots=True)
class Retry:
    """How often to try again, and how long to wait in between.

    Only what may succeed unchanged is tried again: a failed or broken connection, a full queue
    (429), a service that isn't ready (503). The wait doubles from `first` up to `longest`
    seconds, with up to a quarter of random extra so that many clients don't come back at once;
    the service's Retry-After counts if it is longer, but not beyond five minutes.
    """

    attempts: int = 6
    first: float = 0.25
    longest: float = 30.0

    def pause(self, error: ClientError, attempt: int) -> float | None:
        """Seconds to wait after the `attempt`-th failure (from 1); None: don't try again."""
        if attempt >= self.attempts or not isinstance(error, _WORTH_RETRYING):
            return None
        own = self.first * 2.0 ** (attempt - 1) * random.uniform(1.0, 1.25)
        asked = getattr(error, "retry_after", None) or 0.0
        return max(min(self.longest, own), min(asked, MAX_RETRY_AFTER))


NO_RETRY = Retry(attempts=1)
