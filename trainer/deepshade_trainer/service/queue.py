"""Runs the jobs, first come, first served, each in a process of its own that ends with us."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import shutil
import signal
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy.exc import SQLAlchemyError

from deepshade.errors import ConfigError, DeepshadeError
from deepshade.tracing import span
from deepshade_trainer.service.config import Settings
from deepshade_trainer.service.publishing import Publisher
from deepshade_trainer.service.store import (
    CANCELLED,
    DONE,
    FAILED,
    OVER,
    QUEUED,
    RUNNING,
    Job,
    Store,
)
from deepshade_trainer.tuning.events import last_event
from deepshade_trainer.tuning.finished import candidate
from deepshade_trainer.tuning.plan import Plan

log = logging.getLogger("deepshade.trainer")

T = TypeVar("T")

PAUSE = 1.0  # seconds until a database that is away is asked again
MOMENT = 0.05  # seconds
GRACE = 30.0  # seconds in which a job finishes its step and saves


class Queue:
    """The jobs of one store in one folder, which no other service may use meanwhile."""

    def __init__(self, settings: Settings, store: Store, publisher: Publisher) -> None:
        self._settings, self._store, self._publisher = settings, store, publisher
        self._news = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._running: dict[str, asyncio.subprocess.Process] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._cancelled: set[str] = set()
        self._stopping = False
        self._lock = (settings.folder / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise ConfigError(
                "folder", detail=f"another trainer service uses {settings.folder} (--folder)"
            ) from None

    def folder(self, job: str) -> Path:
        """A job's."""
        return self._settings.folder / "jobs" / job

    def wake(self) -> None:
        """There is something new in the store. From any thread."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._news.set)

    async def run(self) -> None:
        """Run jobs until cancelled; then those that run save, and wait for the next start."""
        self._loop = asyncio.get_running_loop()
        await self._patiently(self._store.prepare)
        try:
            while True:
                self._news.clear()  # before the store is asked, or what comes meanwhile is missed
                while len(self._running) < self._settings.at_a_time:
                    job = await self._patiently(self._store.claim)
                    if job is None:
                        break
                    await self._begin(job)
                await self._news.wait()
        finally:
            self._stopping = True
            for process in self._running.values():
                self._keep(self._end(process))
            while self._tasks:
                await asyncio.wait(self._tasks)
            fcntl.flock(self._lock, fcntl.LOCK_UN)
            self._lock.close()

    async def cancel(self, job: Job) -> bool:
        """Stop a job, running or waiting; whether there was something to stop."""
        while True:
            if await asyncio.to_thread(
                lambda: self._store.move(job.id, CANCELLED, of=(QUEUED,), sentence="cancelled")
            ):
                return True
            if (process := self._running.get(job.id)) is not None:
                self._cancelled.add(job.id)
                self._keep(self._end(process))
                return True
            current = await asyncio.to_thread(self._store.get, job.id)
            if current is None or current.state in OVER:
                return False
            await asyncio.sleep(MOMENT)  # its process is just beginning, or its end being noted

    async def _end(self, process: asyncio.subprocess.Process) -> None:
        """Ask a process to stop, and then see to it."""
        _signal(process, signal.SIGTERM)
        try:
            await asyncio.wait_for(process.wait(), GRACE)
        except TimeoutError:
            _signal(process, signal.SIGKILL)

    def _keep(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _begin(self, job: Job) -> None:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "deepshade_trainer.tuning.worker",
            str(self.folder(job.id).resolve()),
            stdin=asyncio.subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": str(self._settings.threads)},
            start_new_session=True,  # Ctrl-C in a terminal is for the service alone
        )
        log.info("job %s of %s/%s begins", job.id, job.effect, job.name)
        self._running[job.id] = process
        self._keep(self._watch(job, process))

    async def _watch(self, job: Job, process: asyncio.subprocess.Process) -> None:
        with span("job", job=job.id, effect=job.effect, bundle=job.name):
            await self._see(job, process)

    async def _see(self, job: Job, process: asyncio.subprocess.Process) -> None:
        code = await process.wait()
        state, values = DONE, dict[str, Any]()
        if job.id in self._cancelled:
            self._cancelled.discard(job.id)
            state, values = CANCELLED, {"sentence": "cancelled"}
            await asyncio.to_thread(shutil.rmtree, self.folder(job.id), ignore_errors=True)
        elif code == 0:
            state, values = await asyncio.to_thread(self._concluded, job)
        elif self._stopping:
            state = QUEUED
        else:
            event = await asyncio.to_thread(last_event, self.folder(job.id)) or {}
            if event.get("phase") != "failed":
                event = {"error": f"its process ended with {code}", "fix": "ask for it again"}
            state, values = FAILED, {"sentence": event["error"], "fix": event["fix"]}
        log.info("job %s is %s %s", job.id, state, values.get("sentence", ""))
        await self._patiently(lambda: self._store.move(job.id, state, of=(RUNNING,), **values))
        del self._running[job.id]
        self.wake()

    def _concluded(self, job: Job) -> tuple[str, dict[str, Any]]:
        """What comes of a job whose process is done: published, or why not."""
        folder = self.folder(job.id)
        try:
            decision = (last_event(folder) or {})["decision"]
            sentence = str(decision["sentence"])
            if not decision["better"]:
                return DONE, {"sentence": sentence}
            bundle = candidate(folder, Plan.read(folder))
            with span("publish"):
                version, said = self._publisher.publish(bundle, job.effect, job.name)
            label = f"published as {job.effect}/{job.name} {version.number}"
            more = f" ({said})" if said else ""
            return DONE, {"sentence": f"{label}: {sentence}{more}", "published": version.number}
        except DeepshadeError as error:
            return FAILED, {"sentence": f"not published: {error}", "fix": error.fix}
        except (OSError, KeyError, ValueError) as error:
            log.exception("job %s can't be published", job.id)
            return FAILED, {"sentence": f"not published: {error}", "fix": "ask for it again"}

    async def _patiently(self, ask: Callable[[], T]) -> T:
        """What the store answers, however long its database is away, unless we stop."""
        told = False
        while True:
            try:
                return await asyncio.to_thread(ask)
            except SQLAlchemyError as error:
                if self._stopping:
                    raise
                if not told:
                    log.error("the database can't be asked, and will be again: %s", error)
                told = True
                await asyncio.sleep(PAUSE)


def _signal(process: asyncio.subprocess.Process, number: int) -> None:
    with suppress(ProcessLookupError):
        process.send_signal(number)
