"""The threads that the whole process shares, and who needs them at the same time."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import TypeVar

from deepshade.machine import cpu_count

Item = TypeVar("Item")

MOST_THREADS = 8  # for one call; what is decoded here gains little from more


class _Crowd(threading.local):
    """Whether this thread counts already."""

    counted = False


_here = _Crowd()
_count = 0
_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_owner = 0


@contextmanager
def busy() -> Iterator[int]:
    """Count this thread as one that needs the CPU; gives how many do, itself included.

    Work that is done at the same time shares the CPUs rather than fight for them. A prediction
    counts by itself; work with predictions inside it may count as a whole.
    """
    global _count
    if _here.counted:
        yield _count
        return
    with _lock:
        _count += 1
        now = _count
    _here.counted = True
    try:
        yield now
    finally:
        _here.counted = False
        with _lock:
            _count -= 1


def thread_count() -> int:
    """How many threads one call of `run_all` may use, the calling one among them."""
    return min(cpu_count(), MOST_THREADS)


def run_all(work: Callable[[Item], None], items: Sequence[Item], threads: int) -> None:
    """Calls `work` for each item, here and on up to `threads` - 1 of the shared threads.

    Never waits for a thread that is busy with another call: what nobody has begun is done here,
    so many calls at once share the machine's threads and each still gets on. Within `busy` it
    asks for no more than its share of them: handing over would cost more than it spares. The
    first error is raised when all have stopped; items that nobody has begun are then left out.
    """
    if _here.counted:
        threads = min(threads, max(1, cpu_count() // max(1, _count)))
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
