"""The trainer service: routes, and what starts and stops with it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Header, Query, Request, Response
from fastapi.responses import FileResponse, PlainTextResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from fastapi_offline import FastAPIOffline

from deepshade.tokens import TokenGuard
from deepshade.tracing import Tracing
from deepshade_trainer.run import Run
from deepshade_trainer.service import problems
from deepshade_trainer.service.config import Settings
from deepshade_trainer.service.problems import Problem
from deepshade_trainer.service.publishing import Publisher, describe
from deepshade_trainer.service.queue import Queue
from deepshade_trainer.service.request import TrainRequest, job_of
from deepshade_trainer.service.store import AGAIN, OVER, QUEUED, Job, Store
from deepshade_trainer.service.telemetry import MEDIA_TYPE as METRICS_TYPE
from deepshade_trainer.service.telemetry import Telemetry
from deepshade_trainer.service.uploads import Uploads
from deepshade_trainer.tuning.events import last_event, read_events

POLL = 0.25  # seconds between looks at a job's events
OPEN = ("/healthz",)
MAX_BODY = 1 << 16  # bytes of a request for a job


class Trainer:
    """What the routes share."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.store = Store(settings.url)
        self.publisher = Publisher(settings)
        self.queue = Queue(settings, self.store, self.publisher)
        self.uploads = Uploads(settings.folder / "uploads", settings.upload_bytes)
        self.telemetry = Telemetry(
            self.store,
            lambda job: last_event(self.queue.folder(job)),
            (settings.folder, settings.published, *settings.data),
        )
        self.stopping = asyncio.Event()

    @asynccontextmanager
    async def running(self, app: FastAPI) -> AsyncIterator[None]:
        """Run the queue meanwhile."""
        task = asyncio.create_task(self.queue.run())
        try:
            yield
        finally:
            self.stopping.set()
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            self.store.close()

    def ask(self, effect: str, asked: TrainRequest) -> tuple[dict[str, Any], bool]:
        """The job that a request gets, and whether it waits anew. Blocks."""
        job, plan, rendering = job_of(effect, asked, self.settings, self.uploads)
        known = self.store.get(job.id)
        if known is None or known.state in AGAIN:
            waiting = self.store.waiting()
            if waiting >= self.settings.queue:
                raise Problem(
                    429, "queue-full", f"{waiting} jobs wait already", "ask again later", 60
                )
            folder = self.queue.folder(job.id)
            plan.write(folder)
            if rendering is not None:
                Path(rendering.out).parent.mkdir(parents=True, exist_ok=True)
                rendering.write(folder)
        job, fresh = self.store.add(job)
        self.queue.wake()
        return self.describe(job), fresh

    def describe(self, job: Job) -> dict[str, Any]:
        """A job as JSON values, with its place in the queue, or how far it is."""
        found = job.document()
        found["before"] = self.store.before(job) if job.state == QUEUED else None
        found["progress"] = last_event(self.queue.folder(job.id))
        return found


def _found(job: str, request: Request) -> Job:
    known: Job | None = request.app.state.trainer.store.get(job[:16])
    if known is None or job != known.id:
        raise Problem(404, "no-job", f"there is no job {job[:40]!r}", "GET /jobs lists them")
    return known


Found = Annotated[Job, Depends(_found)]


def create_app(settings: Settings) -> FastAPI:
    """The ASGI application for these settings. Raises ConfigError where its folder is in use."""
    trainer = Trainer(settings)
    app = FastAPIOffline(  # FastAPI, but /docs needs no internet
        redoc_url=None,
        title="deepshade trainer",
        version=version("deepshade"),
        summary="Fine-tunes shaders, and publishes what is better.",
        lifespan=trainer.running,
    )
    app.state.trainer = trainer
    problems.install(app)
    app.add_middleware(TokenGuard, token=settings.token, guarded=lambda _, path: path not in OPEN)
    app.add_middleware(Tracing)

    @app.post(
        "/train/{effect}",
        tags=["jobs"],
        summary="Fine-tune a shader",
        status_code=202,
        max_body_size=MAX_BODY,
    )
    def train(effect: str, asked: TrainRequest, response: Response) -> dict[str, Any]:
        """The same data, code, settings and seed are the same job: it is found (200), not done
        again. One that failed or was cancelled goes on."""
        document, fresh = trainer.ask(effect, asked)
        if not fresh:
            response.status_code = 200
        return document

    @app.get("/jobs", tags=["jobs"], summary="All jobs, the last first")
    def jobs(limit: Annotated[int, Query(ge=1, le=1000)] = 100) -> list[dict[str, Any]]:
        return [trainer.describe(job) for job in trainer.store.jobs(limit)]

    @app.get("/jobs/{job}", tags=["jobs"], summary="One job")
    def one(job: Found) -> dict[str, Any]:
        return trainer.describe(job)

    @app.delete("/jobs/{job}", tags=["jobs"], summary="Cancel a job")
    async def cancel(job: Found) -> dict[str, Any]:
        """One that runs ends after its step, and leaves nothing behind but its entry."""
        stopped = await trainer.queue.cancel(job)
        return {"id": job.id, "cancelled": stopped}

    @app.get(
        "/jobs/{job}/preview",
        tags=["jobs"],
        summary="Views that judge: ours, the reference, the difference",
        response_class=Response,
        responses={200: {"content": {"image/png": {}}}},
    )
    def preview(job: Found) -> Response:
        path = Run(trainer.queue.folder(job.id) / "run").preview
        if not path.is_file():
            raise Problem(404, "no-preview", f"job {job.id} has no picture yet", "ask later")
        return FileResponse(path, media_type="image/png", headers={"Cache-Control": "no-store"})

    @app.get(
        "/jobs/{job}/events",
        tags=["jobs"],
        summary="How a job goes, as it goes",
        response_class=EventSourceResponse,
    )
    async def events(
        job: Found, last_event_id: Annotated[int, Header(ge=0)] = 0
    ) -> AsyncIterable[ServerSentEvent]:
        """Server-sent events: `job` when its state changes, `progress` with phase, step, loss,
        validation, rate (steps a second), seconds left; the last is `end`. Reconnecting with
        Last-Event-ID goes on after that one."""
        folder, offset, number, state = trainer.queue.folder(job.id), 0, last_event_id, ""
        skip = last_event_id
        while not trainer.stopping.is_set():
            current = await asyncio.to_thread(trainer.store.get, job.id) or job
            if current.state != state:
                state = current.state
                described = await asyncio.to_thread(trainer.describe, current)
                yield ServerSentEvent(data=described, event="job")
            news, offset = await asyncio.to_thread(read_events, folder, skip, offset)
            skip = 0
            for event in news:
                number += 1
                yield ServerSentEvent(data=event, event="progress", id=str(number))
            if state in OVER:
                described = await asyncio.to_thread(trainer.describe, current)
                yield ServerSentEvent(data=described, event="end")
                return
            await asyncio.sleep(POLL)

    _bundles(app, trainer)
    _data(app, trainer)

    @app.get("/healthz", tags=["operation"], summary="Is the process alive?")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get("/readyz", tags=["operation"], summary="Does its database answer?")
    def readyz() -> dict[str, Any]:
        return {"status": "ready", "waiting": trainer.store.waiting()}

    @app.get(
        "/metrics",
        tags=["operation"],
        summary="Jobs and what they do, for Prometheus",
        response_class=PlainTextResponse,
    )
    def metrics() -> Response:
        return PlainTextResponse(trainer.telemetry.render(), media_type=METRICS_TYPE)

    return app


def _bundles(app: FastAPI, trainer: Trainer) -> None:
    publisher = trainer.publisher

    @app.get("/bundles", tags=["bundles"], summary="What was published, with its versions")
    def bundles() -> list[dict[str, Any]]:
        return publisher.listed()

    @app.post("/bundles/{effect}/{name}/pin", tags=["bundles"], summary="Stay at one version")
    def pin(effect: str, name: str, version: Annotated[int, Query(ge=1)]) -> dict[str, Any]:
        """The services are told. Nothing that is published moves the alias then."""
        said = publisher.pin(effect, name, version)
        return describe(publisher.alias(effect, name)) | {"said": said}

    @app.delete("/bundles/{effect}/{name}/pin", tags=["bundles"], summary="Follow again")
    def unpin(effect: str, name: str) -> dict[str, Any]:
        """What is published next moves the alias again; until then it stays."""
        publisher.unpin(effect, name)
        return describe(publisher.alias(effect, name)) | {"said": ""}

    @app.post("/bundles/{effect}/{name}/rollback", tags=["bundles"], summary="Go back by one")
    def rollback(effect: str, name: str) -> dict[str, Any]:
        """To the version before the current one; the services are told. A pin is lost."""
        said = publisher.roll_back(effect, name)
        return describe(publisher.alias(effect, name)) | {"said": said}


def _data(app: FastAPI, trainer: Trainer) -> None:
    uploads = trainer.uploads

    @app.get("/data/{name}", tags=["data"], summary="What of an upload is there")
    def listed(name: str) -> dict[str, Any]:
        return uploads.describe(name)

    @app.put("/data/{name}/{file:path}", tags=["data"], summary="Send one file of a data set")
    async def put(name: str, file: str, request: Request) -> dict[str, Any]:
        """`shard-00000.safetensors`, …, `environments/<sha256>.exr`, and `manifest.json` last."""
        return await uploads.receive(name, file, request.stream())

    @app.delete("/data/{name}", tags=["data"], summary="Delete an upload")
    def remove(name: str) -> dict[str, Any]:
        return {"name": name, "deleted": uploads.remove(name)}
