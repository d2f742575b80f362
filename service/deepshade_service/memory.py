"""Memory: how much is in use, sharing it between requests, and giving it back."""

from __future__ import annotations

import ctypes
import os
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from deepshade.errors import ConfigError

_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}


def parse_size(text: str | int) -> int:
    """Bytes in '1536M', '2g', '1.5 GiB' or a plain number; ConfigError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?\s*", str(text).lower())
    if match is None:
        raise ConfigError("memory", detail=f"'{text}' is no size; write for example 512M or 2G")
    return int(float(match[1]) * _UNITS[match[2]])


def resident() -> int:
    """Bytes of this process in physical memory; 0 where the system doesn't say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:  # not Linux
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def trim() -> None:
    """Return freed memory to the system. glibc otherwise keeps what lies below its heap's top."""
    if _malloc_trim is not None:
        _malloc_trim(0)


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


def _find_malloc_trim() -> ctypes._NamedFuncPointer | None:
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):  # musl has no malloc_trim
        return None


_malloc_trim = _find_malloc_trim()
