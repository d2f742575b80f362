"""The routes of live sessions: publish, view, list, and links for viewers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI, Request, WebSocket
from starlette.websockets import WebSocketDisconnect

from deepshade import live
from deepshade.errors import DeepshadeError
from deepshade_service import problems
from deepshade_service.described import errors
from deepshade_service.live.answer import Want
from deepshade_service.live.asking import Asking, Reader
from deepshade_service.live.connection import Connection
from deepshade_service.live.history import History
from deepshade_service.live.pipeline import Pipeline, source_time
from deepshade_service.live.session import Session, Sessions
from deepshade_service.live.tokens import Tokens
from deepshade_service.live.viewer import Outlet, Viewer
from deepshade_service.models import not_ready
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem

if TYPE_CHECKING:
    from deepshade_service.app import Service

_HELLO = 10.0  # seconds for the first message
_STATUS = 1.0
_REFUSED = {
    401: "The service's token is needed, or a link's",
    403: "Others can reach the service, and it has no token",
}


def install(app: FastAPI, service: Service, sessions: Sessions, tokens: Tokens) -> None:
    """Add the routes to `app`."""

    @app.websocket("/live/{name}/publish")
    async def publish(socket: WebSocket, name: str) -> None:
        connection = Connection(socket)
        async with _told(connection):
            await connection.open()
            tokens.check(socket)
            await _publish(connection, name, service, sessions)

    @app.websocket("/live/{name}/view")
    async def view(socket: WebSocket, name: str) -> None:
        connection = Connection(socket)
        async with _told(connection):
            await connection.open()
            tokens.check_viewer(socket, name)
            await _view(connection, sessions.find(name))

    @app.get(
        "/live",
        tags=["live"],
        summary="The live sessions, each with its last status",
        responses=errors(_REFUSED),
    )
    async def listed(request: Request) -> list[dict[str, Any]]:
        tokens.check(request)
        return [{"session": each.name, **each.status(0)} for each in sessions.all()]

    @app.post(
        "/live/{name}/link",
        tags=["live"],
        summary="A link for viewers, for an hour",
        responses=errors(_REFUSED | {404: "No such session"}),
    )
    async def link(request: Request, name: str) -> dict[str, Any]:
        tokens.check(request)
        sessions.find(name)
        token, expires = tokens.link(name)
        return {"token": token, "path": f"/live/{name}#token={token}", "expires": expires}


@asynccontextmanager
async def _told(connection: Connection) -> AsyncIterator[None]:
    """What goes wrong within is told, and the connection closed."""
    with suppress(WebSocketDisconnect, RuntimeError):  # nobody is there to be told
        try:
            yield
        except* Problem as group:
            await connection.refuse(_first(group, Problem))
        except* DeepshadeError as group:
            error = _first(group, DeepshadeError)
            await connection.refuse(problems.from_error(error, ShadeParameters.model_fields))
        except* (WebSocketDisconnect, OSError):
            pass


def _first(group: BaseExceptionGroup[Any], kind: type[Any]) -> Any:
    found: BaseException = group
    while isinstance(found, BaseExceptionGroup):
        found = found.exceptions[0]
    assert isinstance(found, kind), "it was caught as one"
    return found


async def _publish(connection: Connection, name: str, service: Service, sessions: Sessions) -> None:
    messages = connection.messages()
    hello = await _hello(messages)
    if not service.models.ready:
        raise not_ready(service.models)
    reader = Reader(service.models)
    asking = reader.read(hello)
    want = _wanted(hello)
    session = sessions.open(name, hello.get("resume"))
    replaced = session.replaced
    try:
        limits = service.settings.limits
        await connection.say(
            {
                "type": "welcome",
                "protocol": 1,
                "session": session.name,
                "resume": session.resume,
                "clock": time.time(),
                "inputs": _inputs(asking),
                "codecs": live.available(),
                "limits": {
                    "frame_bytes": service.settings.live_frame,
                    "pixels": limits.pixels,
                    "rate": service.settings.live_rate,
                    "window": 2,
                },
            }
        )
        every = hello.get("every") is True
        outlet = Outlet(connection.send, every=every, window=None)
        history = History() if hello.get("history") is True else None
        sides = connection.say, outlet, want, history
        pipeline = Pipeline(service.shader, service.telemetry, session, reader, *sides)
        listening = _listen(connection, messages, session, pipeline, service)
        await _until_first_ends(
            listening,
            pipeline.run(),
            connection.compare_clocks(),
            _report(connection, session, outlet, about=False),
            replaced.wait(),
        )
    finally:
        if not (replaced.is_set() or session.ended.is_set()):
            sessions.leave(session)


async def _listen(
    connection: Connection,
    messages: AsyncIterator[dict[str, Any] | bytes],
    session: Session,
    pipeline: Pipeline,
    service: Service,
) -> None:
    """Take frames until the publisher leaves. If it says that this is the end, the session ends."""
    allowed, at = float(service.settings.live_rate), time.monotonic()
    async for message in messages:
        if isinstance(message, bytes):
            now = time.monotonic()
            rate = service.settings.live_rate
            allowed, at = min(rate, allowed + rate * (now - at)), now
            if len(message) > service.settings.live_frame:
                raise _too_large(len(message), service.settings.live_frame)
            session.meter.got(len(message))
            if allowed < 1:
                session.meter.dropped += 1
                continue
            allowed -= 1
            frame = live.parse(message, service.settings.limits)
            if frame.kind != live.GBUFFER:
                raise live.FrameError(f"a publisher sends kind {live.GBUFFER}, not {frame.kind}")
            pipeline.offer(frame, source_time(frame, connection.ahead))
        elif message["type"] == "end":
            # at once, not when what is inferred is done: who comes next may want the name
            service.sessions.end(session)
            return


async def _view(connection: Connection, session: Session) -> None:
    viewer = Viewer(connection.send)
    session.add(viewer)
    try:
        await connection.say(
            {
                "type": "welcome",
                "protocol": 1,
                "session": session.name,
                "clock": time.time(),
                "effects": session.effects,
            }
        )
        if session.last is not None:
            await viewer.offer(session.last, rest=False)
        await _until_first_ends(
            _watch(connection, viewer),
            viewer.outlet.run(),
            _report(connection, session, viewer.outlet),
            session.ended.wait(),
        )
        if session.ended.is_set():
            await connection.say(session.status(0))
            await connection.close(4404)
    finally:
        session.viewers.discard(viewer)


async def _watch(connection: Connection, viewer: Viewer) -> None:
    async for message in connection.messages():
        if isinstance(message, bytes):
            raise Problem(422, "bad-message", "a viewer sends no frames")
        if message["type"] == "want":
            viewer.want(message)
        elif message["type"] == "ack":
            viewer.outlet.acknowledge(message.get("id"))


async def _report(
    connection: Connection, session: Session, outlet: Outlet, *, about: bool = True
) -> None:
    """Say each second how it goes, and how answers are made when that has changed.

    A publisher hears that before the answer.
    """
    sent = outlet.sent_bytes
    told: dict[str, Any] = {}
    while True:
        if about and (plans := session.about()) and plans != told:
            told = plans
            await connection.say({"type": "about", "effects": plans})
        await connection.say(session.status(outlet.sent_bytes - sent))
        sent = outlet.sent_bytes
        await asyncio.sleep(_STATUS)


async def _hello(messages: AsyncIterator[dict[str, Any] | bytes]) -> dict[str, Any]:
    with suppress(TimeoutError):
        async with asyncio.timeout(_HELLO):
            async for message in messages:
                if isinstance(message, dict) and message["type"] == "hello":
                    if message.get("protocol") == 1:
                        return message
                    raise Problem(422, "bad-message", "this service speaks protocol 1 alone")
                break
            else:
                raise WebSocketDisconnect
    raise Problem(
        422,
        "bad-message",
        "a publisher says hello first",
        fix="docs/streaming.md says what a publisher says",
    )


def _wanted(hello: dict[str, Any]) -> Want | None:
    codec = hello.get("answers", "deflate")
    if codec == "none":
        return None
    if codec not in (names := live.available()):
        raise Problem(
            422,
            "bad-parameter",
            f'"answers": {str(codec)[:40]!r} is no codec that this service has',
            fix=f"one of: {', '.join(names)}, none",
        )
    return Want(codec, half=hello.get("half") is not False)


def _inputs(asking: Asking) -> dict[str, list[str]]:
    """What the networks need that may shade each effect, and its light where that stays."""
    found = {}
    for effect, candidates in zip(asking.effects, asking.candidates, strict=True):
        names = [name for bundle, _ in candidates for name in bundle.inputs]
        names += ["light"] if effect.background == "light" else []
        found[effect.name] = list(dict.fromkeys(names))
    return found


def _too_large(size: int, most: int) -> Problem:
    return Problem(
        413,
        "over-limit",
        f"a frame has {size:,} bytes, the limit is {most:,}",
        fix="send smaller frames, or start the service with a higher --live-frame",
    )


async def _until_first_ends(*work: Coroutine[Any, Any, Any]) -> Any:
    """Runs all until one ends; that one's result. The others are cancelled."""
    tasks = [asyncio.ensure_future(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return next(task for task in tasks if task in done).result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
