"""A few worker threads behind a bounded queue: CPU-bound work stays off the event loop."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from typing import Any, TypeVar

from deepshade_service.problems import Problem

T = TypeVar("T")

_MAX_RETRY = 60  # seconds
_RUNS = 2  # of a job: one for its headers, one for its pixels


class Cancelled(Exception):
    """The work was given up: its client went away, or the service stops."""


async def unless(event: Coroutine[Any, Any, object], error: Exception, work: Awaitable[T]) -> T:
    """The work's result; if `event` comes first the work is cancelled, and `error` raised."""
    job, other = asyncio.ensure_future(work), asyncio.ensure_future(event)
    try:
        await asyncio.wait({job, other}, return_when=asyncio.FIRST_COMPLETED)
        if not job.done():
            raise error
        return job.result()
    finally:
        await end(job, other)


async def end(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks, and return when all have ended; what they raise is dropped.

    Who is cancelled meanwhile gets that then: to suppress what awaiting them raises would lose it.
    """
    for task in tasks:
        task.cancel()
    await until_done(*tasks)


async def until_done(*tasks: asyncio.Future[Any]) -> None:
    """Returns when all have ended; raises CancelledError only then."""
    cancelled: asyncio.CancelledError | None = None
    while left := [task for task in tasks if not task.done()]:
        try:
            await asyncio.wait(left)
        except asyncio.CancelledError as error:
            cancelled = error
    for task in tasks:
        if not task.cancelled():
            task.exception()  # so that asyncio doesn't report it as never retrieved
    if cancelled is not None:
        raise cancelled


class Workers:
    """`threads` jobs run at a time, `queue` more may wait, and the next one is refused.

    What waits does so on the event loop: a thread only ever gets what it runs now, so nothing of
    a job that is given up stays behind in a queue. Only for use on the event loop.
    """

    def __init__(self, threads: int, queue: int) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="shade")
        self._idle = asyncio.Semaphore(threads)
        self._threads = threads
        self._places = threads + queue
        self._running: set[threading.Event] = set()
        self._typical = 0.0
        self._stopped = False
        self.taken = 0  # jobs that run or wait
        self.last_end = time.monotonic()

    def check_place(self) -> None:
        """Raises Problem 429 when the queue is full."""
        if self.taken < self._places:
            return
        wait = _RUNS * self._typical * (self.taken - self._threads + 1) / self._threads
        retry = min(_MAX_RETRY, max(1, math.ceil(wait)))
        raise Problem(
            429,
            "queue-full",
            f"{self.taken} pictures are being shaded or wait already",
            fix=f"try again in {retry} s",
            headers={"Retry-After": str(retry)},
        )

    @contextmanager
    def place(self) -> Iterator[None]:
        """A job's place in the queue, for as long as the block lasts. Raises Problem 429."""
        self.check_place()
        self.taken += 1
        try:
            yield
        finally:
            self.taken -= 1
            self.last_end = time.monotonic()

    async def run(self, work: Callable[[threading.Event], T]) -> T:
        """Run `work` on a worker, as soon as one is idle.

        It gets an event that is set when nobody wants it any more. A caller that is cancelled
        meanwhile gets that only when the thread has ended, so what the caller holds for the work
        is held until then. Raises Cancelled when the service has stopped.
        """
        async with self._idle:
            if self._stopped:
                raise Cancelled
            cancelled = threading.Event()
            self._running.add(cancelled)
            start = time.monotonic()
            future = asyncio.get_running_loop().run_in_executor(
                self._pool, copy_context().run, work, cancelled
            )
            try:
                return await asyncio.shield(future)
            except asyncio.CancelledError:
                cancelled.set()
                await until_done(future)
                raise
            finally:
                self._running.discard(cancelled)
                took = time.monotonic() - start
                self._typical = 0.8 * self._typical + 0.2 * took if self._typical else took

    async def stop(self) -> None:
        """Give up everything that runs or waits; running work ends at its next look."""
        self._stopped = True
        for cancelled in self._running:
            cancelled.set()
        await asyncio.to_thread(self._pool.shutdown)
