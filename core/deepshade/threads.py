"""The threads that the whole process shares, for work on pieces of one picture."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TypeVar

from deepshade.machine import cpu_count

Item = TypeVar("Item")

MAX_THREADS = 8  # for one call; what is decoded here gains little from more


_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_owner = 0


def thread_count() -> int:
    """How many threads one call of `run_all` may use, the calling one among them."""
    return min(cpu_count(), MAX_THREADS)


def run_all(work: Callable[[Item], None], items: Sequence[Item], threads: int) -> None:
    """Calls `work` for each item, here and on up to `threads` - 1 of the shared threads.

    Never waits for a thread that is busy with another call: what nobody has begun is done here,
    so many calls at once share the machine's threads and each still gets on. The first error is
    raised when all have stopped; items that nobody has begun are then left out.
    """
    waiting = deque(items)

    def drain() -> None:
        while True:
            try:
                item = waiting.popleft()
            except IndexError:
                return
            try:
                work(item)
            except BaseException:
                waiting.clear()
                raise

    helpers = []
    with suppress(RuntimeError):  # the interpreter is shutting down: no new threads
        for _ in range(min(threads, len(items)) - 1):
            helpers.append(_shared().submit(drain))
    try:
        drain()
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        errors = [error for helper in begun if (error := helper.exception()) is not None]
    if errors:
        raise errors[0]


def _shared() -> ThreadPoolExecutor:
    """The pool; another one in a forked child, which gets none of its parent's threads."""
    global _pool, _owner
    with _lock:
        if _pool is None or _owner != os.getpid():
            _pool = ThreadPoolExecutor(max(1, cpu_count() - 1), thread_name_prefix="deepshade-exr")
            _owner = os.getpid()
        return _pool
