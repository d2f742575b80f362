"""Memory: how much is in use, sharing it between requests, and giving it back."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from deepshade.errors import ConfigError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def parse_size(text: str | int) -> int:
    """Bytes in '1536M', '2g', '1.5 GiB' or a plain number; ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?\s*", str(text).lower())
    if match is None:
        raise ConfigError("memory", detail=f"'{text}' is no size; write for example 512M or 2G")
    return int(float(match[1]) * _UNITS[match[2]])


class MemoryBudget:
    """Bytes that requests share; a request waits until its part is free, so the sum is bounded."""

    def __init__(self, total: int) -> None:
        self.total = total
        self._free = total
        self._changed = threading.Condition()

    @contextmanager
    def hold(self, amount: int, cancelled: threading.Event | None = None) -> Iterator[None]:
        """Hold `amount` bytes (at most the total); blocks, so call it from a worker thread.

        Gives up waiting, without the memory, when `cancelled` is set: the caller must look at it.
        """
        amount = min(amount, self.total)
        with self._changed:
            while self._free < amount:
                if cancelled is not None and cancelled.is_set():
                    amount = 0
                    break
                self._changed.wait(timeout=0.2)
            self._free -= amount
        try:
            yield
        finally:
            with self._changed:
                self._free += amount
                self._changed.notify_all()
