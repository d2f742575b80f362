"""A few worker threads behind a bounded queue: CPU-bound work stays off the event loop."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from deepshade_service.problems import Problem

T = TypeVar("T")

_MOST_RETRY = 60


class Cancelled(Exception):
    """The work was given up: its client went away, or the service stops."""


class Workers:
    """`threads` jobs run at a time, `queue` more may wait, and the next one is refused."""

    def __init__(self, threads: int, queue: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="shade")
        self._threads = threads
        self._places = threads + queue
        self._jobs: set[threading.Event] = set()
        self._typical = 0.0
        self.last_end = time.monotonic()

    @property
    def taken(self) -> int:
        """Jobs that run or wait."""
        return len(self._jobs)

    def check_room(self) -> None:
        """Raises Problem 429 when the queue is full."""
        if self.taken < self._places:
            return
        wait = self._typical * (self.taken - self._threads + 1) / self._threads
        retry = min(_MOST_RETRY, max(1, math.ceil(wait)))
        raise Problem(
            429,
            "queue-full",
            f"{self.taken} pictures are being shaded or wait already",
            fix=f"try again in {retry} s",
            headers={"Retry-After": str(retry)},
        )

    async def run(self, work: Callable[[threading.Event], T]) -> T:
        """Run `work` on a worker. It gets an event that is set when nobody wants it any more.

        Raises Problem 429 when the queue is full, Cancelled when the work gave up.
        """
        self.check_room()
        cancelled = threading.Event()
        self._jobs.add(cancelled)

        def timed() -> T:
            if cancelled.is_set():
                raise Cancelled
            start = time.monotonic()
            try:
                return work(cancelled)
            finally:
                took = time.monotonic() - start
                self._typical = 0.8 * self._typical + 0.2 * took if self._typical else took

        future = asyncio.get_running_loop().run_in_executor(self._pool, timed)
        # Free the place when the thread is free, which may be later than when the caller left.
        future.add_done_callback(lambda _: self._finish(cancelled))
        try:
            return await asyncio.shield(future)
        except asyncio.CancelledError:
            cancelled.set()
            future.add_done_callback(_forget)
            raise

    def stop(self) -> None:
        """Give up everything that runs or waits; running work ends at its next look."""
        for cancelled in list(self._jobs):
            cancelled.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _finish(self, cancelled: threading.Event) -> None:
        self._jobs.discard(cancelled)
        self.last_end = time.monotonic()


def _forget(future: asyncio.Future[T]) -> None:
    if not future.cancelled():
        future.exception()  # so that asyncio doesn't report it as never retrieved
