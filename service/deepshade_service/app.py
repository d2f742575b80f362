"""The HTTP service: routes, and what starts and stops with it."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from importlib.metadata import version
from typing import Annotated, Any

from fastapi import FastAPI, Query, Request, Response
from fastapi.responses import PlainTextResponse
from fastapi_offline import FastAPIOffline

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS, SETTINGS, Setting
from deepshade.engines import Engine
from deepshade.errors import EngineError
from deepshade.files import shipped
from deepshade.machine import trim
from deepshade.tokens import TokenGuard
from deepshade.tracing import Tracing
from deepshade_service import bundle_routes, composition, pages, problems, upload_routes
from deepshade_service import environment_routes as routes
from deepshade_service.answers import Shaded
from deepshade_service.config import Settings, environment_limits
from deepshade_service.described import errors
from deepshade_service.environments import SHARE, Environments
from deepshade_service.guard import Guard, cross_origin
from deepshade_service.kept import Kept
from deepshade_service.live import routes as live_routes
from deepshade_service.live.session import Sessions
from deepshade_service.live.tokens import Tokens
from deepshade_service.memory import MemoryBudget
from deepshade_service.middleware import Closing, Counting
from deepshade_service.models import Models, find_effect, find_effects, not_ready
from deepshade_service.parameters import ShadeParameters
from deepshade_service.selection import allowed
from deepshade_service.shading import Shader
from deepshade_service.telemetry import MEDIA_TYPE as METRICS_TYPE
from deepshade_service.telemetry import Telemetry, server_timing
from deepshade_service.uploads import Upload, Uploads, refuse_body
from deepshade_service.workers import Cancelled, Workers, unless


class Service:
    """What the routes share: settings, models, workers, memory, counters."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        pinned = settings.engine, settings.precision
        self.models = Models(settings.models, threads=settings.threads, pinned=pinned)
        self.workers = Workers(settings.workers, settings.queue)
        self.uploads = Uploads(settings)
        self.kept = Kept(settings.keep, settings.keep_seconds, shipped("samples"))
        self.memory = MemoryBudget(settings.memory)
        self.environments = Environments(
            settings.environments,
            environment_limits(settings.limits),
            int(SHARE * settings.memory),
        )
        self.stopping = asyncio.Event()  # what is shaded then is finished, and no more is loaded
        self.shader = Shader(
            self.models,
            self.workers,
            self.memory,
            settings.limits,
            self.environments,
            self.stopping,
        )
        self.sessions = Sessions(settings)
        self.tokens = Tokens(settings.token, beyond=settings.beyond)
        self.telemetry = Telemetry(
            queued=lambda: self.workers.taken, held=lambda: self.uploads.held
        )

    @asynccontextmanager
    async def running(self, app: FastAPI) -> AsyncIterator[None]:
        """Verify bundles in the background, so that /healthz answers meanwhile; stop in the end."""
        tasks = [asyncio.create_task(self.models.load()), asyncio.create_task(self._tidy())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            self.sessions.stop()
            await self.workers.stop()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def shade(self, names: str, request: Request, asked: ShadeParameters) -> Shaded:
        """Receive, queue and shade one picture, by one effect or a list as "ao,gi"."""
        effects = find_effects(names)
        candidates = [allowed(self.models, effect.name, asked) for effect in effects]
        asked.check(effects)
        composition.check(asked, effects)
        if asked.environment is not None:
            self.environments.check(asked.environment)
        self.workers.check_place()  # before the body is received, to spare both sides the work
        async with self._files(request, asked) as files:
            with self.workers.place():
                work = self.shader.shade(files, asked, candidates)
                shaded = await unless(_gone(request), Cancelled(), work)
        for made in () if asked.explain else shaded.made:
            shared = {name: ms / len(shaded.made) for name, ms in shaded.milliseconds.items()}
            nonfinite = int(made.facts["nonfinite_pixels"])
            stages = {**shared, **made.milliseconds}
            self.telemetry.shaded(made.effect, stages, made.pixels, made.computed, nonfinite)
        return shaded

    @asynccontextmanager
    async def _files(self, request: Request, asked: ShadeParameters) -> AsyncIterator[list[Upload]]:
        """Those of the body, or of the upload that is asked for."""
        if asked.upload is None:
            async with self.uploads.receive(request) as files:
                yield files
        else:
            refuse_body(request)
            with self.kept.use(asked.upload) as files:
                yield files

    async def _tidy(self) -> None:
        """Give memory back when nothing has been shaded for a while; forget old uploads."""
        tidied = time.monotonic()
        while True:
            await asyncio.sleep(self.settings.idle_trim / 2)
            self.kept.tidy()
            ended = self.workers.last_end
            idle = time.monotonic() - ended
            if ended > tidied and not self.workers.taken and idle > self.settings.idle_trim:
                tidied = time.monotonic()
                await asyncio.to_thread(_release, self.models.engines())


def create_app(settings: Settings | None = None) -> FastAPI:
    """The ASGI application for these settings."""
    service = Service(settings or Settings())
    app = FastAPIOffline(  # FastAPI, but /docs needs no internet
        redoc_url=None,
        title="deepshade",
        version=version("deepshade"),
        summary="Neural screen-space shading: a G-buffer in, shaded appearance out.",
        lifespan=service.running,
    )
    app.state.service = service
    problems.install(app, ShadeParameters.model_fields)
    cross_origin(app, service.settings.origins)
    app.add_middleware(Guard, hosts=service.settings.hosts, origins=service.settings.origins)
    app.add_middleware(Counting, telemetry=service.telemetry)
    app.add_middleware(Closing)
    app.add_middleware(TokenGuard, token=service.settings.token, guarded=bundle_routes.guarded)
    app.add_middleware(Tracing)

    @app.post(
        "/shade/{effect}",
        tags=["shade"],
        summary="Shade a G-buffer",
        response_class=Response,
        responses=_SHADE_RESPONSES,
        openapi_extra={"requestBody": _SHADE_BODY},
    )
    async def shade(
        effect: str, request: Request, asked: Annotated[ShadeParameters, Query()]
    ) -> Response:
        """Send one EXR as the body, or the files of a form, or name what is kept (`?upload=`).

        Takes any size from 1x1 up. Pixels that aren't finite are background. The answer's
        headers, and its EXR header, say how it was made. With `explain=1` the answer is the plan
        as JSON: which bundle on which engine and why, what of the picture would be computed, and
        which channels were decoded for it.

        `effect` may be a list, as `ao,gi`: one decode, and one EXR in which each is a layer
        (`ao.Y`, `gi.R`). A setting counts for all that have it, and so does what chooses a bundle.
        """
        try:
            answer = await service.shade(effect, request, asked)
        except Cancelled:
            return Response(status_code=503)  # nobody is there to read it
        headers = {_header_name(name): _header_value(v) for name, v in answer.facts.items()}
        headers["Server-Timing"] = server_timing(answer.stages)
        return Response(answer.content, media_type=answer.media_type, headers=headers)

    @app.get(
        "/effects",
        tags=["effects"],
        summary="All effects and their bundles",
        responses=errors({503: "The bundles aren't verified yet"}),
    )
    async def effects() -> list[dict[str, Any]]:
        return [_effect(name, service.models) for name in EFFECTS]

    @app.get(
        "/effects/{effect}",
        tags=["effects"],
        summary="One effect: inputs, bundles, metrics",
        responses=errors({404: "Unknown effect", 503: "The bundles aren't verified yet"}),
    )
    async def one_effect(effect: str) -> dict[str, Any]:
        return _effect(find_effect(effect).name, service.models)

    bundle_routes.install(app, service.models)
    routes.install(app, service.environments, service.uploads, service.settings)
    live_routes.install(app, service, service.sessions, service.tokens)
    upload_routes.install(app, service)
    pages.install(app)

    @app.get("/healthz", tags=["operation"], summary="Is the process alive?", responses=errors({}))
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @app.get(
        "/readyz",
        tags=["operation"],
        summary="Are the bundles verified?",
        responses=errors({503: "Not yet"}),
    )
    async def readyz() -> dict[str, Any]:
        if not service.models.ready:
            raise not_ready(service.models)
        models = service.models
        bundles = [f"{name}/{bundle.name}" for name in EFFECTS for bundle in models.bundles(name)]
        return {"status": "ready", "bundles": bundles, "refused": models.refused}

    @app.get(
        "/metrics",
        tags=["operation"],
        summary="Counters, for Prometheus",
        response_class=PlainTextResponse,
        responses=errors({}),
    )
    async def metrics() -> Response:
        return PlainTextResponse(service.telemetry.render(), media_type=METRICS_TYPE)

    return app


def _release(engines: list[Engine]) -> None:
    for engine in engines:
        engine.shrink()
    trim()


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _effect(name: str, models: Models) -> dict[str, Any]:
    effect = EFFECTS[name]
    return {
        "name": name,
        "title": effect.title,
        "inputs": [
            {
                "attribute": i,
                "channels": ATTRIBUTES[i].channels,
                "unit": ATTRIBUTES[i].unit.name,
                "meaning": ATTRIBUTES[i].meaning,
            }
            for i in effect.inputs
        ],
        "outputs": effect.outputs,
        "light": effect.is_light,
        "reference": effect.reference,
        "background": effect.background,
        "settings": [_setting(s) for s in SETTINGS.values() if effect.takes(s)],
        "bundles": [_bundle(bundle, models) for bundle in models.bundles(name)],
    }


def _setting(setting: Setting) -> dict[str, Any]:
    """Without it, what an image's `header` says counts, else the `default`.

    A length may be `learnt`: between which shares of a picture's median depth.
    """
    return {
        "name": setting.name,
        "unit": setting.unit,
        "meaning": setting.meaning,
        "lowest": setting.lowest,
        "highest": setting.highest,
        "header": setting.header if setting.stored else None,
        "default": setting.default,
        "learnt": setting.learnt if setting.share else None,
    }


def _bundle(bundle: Bundle, models: Models) -> dict[str, Any]:
    backend = None
    with suppress(EngineError):  # pinned by the operator, and not for this bundle
        backend = models.backend(bundle)
    return {
        "name": bundle.name,
        "sha256": bundle.sha256,
        "inputs": bundle.inputs,
        "radius": bundle.radius,
        "size_multiple": bundle.size_multiple,
        "halo": bundle.halo,
        "engine": backend and backend.engine,
        "precision": backend and backend.precision,
        "dssim": bundle.dssim,
        "times": _times(bundle, str(backend)),
        "metrics": bundle.metrics,
    }


def _times(bundle: Bundle, backend: str) -> list[dict[str, Any]]:
    """What the network was published to take on that backend: on which machine, for what size."""
    return [
        {"machine": machine, "size": found["size"], "ms": found["ms"][backend]}
        for machine, found in bundle.metrics.get("speed", {}).items()
        if backend in found["ms"]
    ]


def _header_name(fact: str) -> str:
    return "Deepshade-" + fact.replace("_", "-").title()


def _header_value(value: object) -> str:
    """Printable ASCII: channel names come from strangers and may hold anything.

    The facts of one effect among several are JSON: in a header for each there would be more
    headers than many clients take.
    """
    if isinstance(value, dict):
        return json.dumps({name: _header_value(fact)[:200] for name, fact in value.items()})
    text = f"{value:.9g}" if isinstance(value, float) else str(value)
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:2000].strip()


_BINARY = {"schema": {"type": "string", "format": "binary"}}
_SHADE_BODY = {
    "required": True,
    "content": {
        "image/x-exr": _BINARY,
        "application/octet-stream": _BINARY,
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "description": "EXR files: one, one for each attribute, or several parts.",
                "additionalProperties": _BINARY["schema"],
            }
        },
    },
}
_SHADE_RESPONSES: dict[int | str, Any] = {
    200: {
        "description": "The shaded picture",
        "content": {
            "image/x-exr": _BINARY,
            "image/png": _BINARY,
            "application/json": {"schema": {"type": "object", "description": "With explain=1"}},
        },
    }
}
_SHADE_RESPONSES |= errors(
    {
        404: "Unknown effect, or no bundle for it",
        410: "The upload is no longer kept",
        415: "Another content type than EXR or a form",
        422: "A missing attribute, a bad parameter, or a G-buffer that contradicts itself",
        500: "A bundle that can't be loaded, or a failure inside",
        503: "The bundles aren't verified yet",
    },
    uploads=True,
)
