"""Whom browsers may act for. A WebSocket is refused before it exists."""

from __future__ import annotations

import asyncio
import json
import socket
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket

from deepshade_service.app import create_app
from deepshade_service.config import Settings
from deepshade_service.guard import Guard, cross_origin

FOREIGN = "https://evil.example.com"


def service(*hosts: str, origins: tuple[str, ...] = ()) -> Starlette:
    async def plain(_: object) -> PlainTextResponse:
        return PlainTextResponse("done")

    async def echo(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text("open")
        await websocket.close()

    routes = [Route("/do", plain, methods=["GET", "POST"]), WebSocketRoute("/ws", echo)]
    app = Starlette(routes=routes)
    cross_origin(app, origins)
    app.add_middleware(Guard, hosts=hosts, origins=origins)
    return app


def ask(app: Any, method: str, path: str = "/do", **how: Any) -> httpx.Response:
    async def send() -> httpx.Response:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url="http://testserver") as client:
            return await client.request(method, path, **how)

    return asyncio.run(send())


def websocket(headers: dict[str, str], *extensions: str) -> list[dict[str, Any]]:
    """What a server is sent for a client that wants to open one."""
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    raw = [(k.encode(), v.encode()) for k, v in ({"host": "testserver"} | headers).items()]
    scope = {"type": "websocket", "path": "/ws", "headers": raw, "query_string": b""}
    scope["extensions"] = {name: {} for name in extensions}
    asyncio.run(service()(scope, receive, send))
    return sent


def status(host: str, *hosts: str, **headers: str) -> int:
    return ask(service(*hosts), "POST", headers={"host": host, **headers}).status_code


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8000", "[::1]:8000", "192.168.1.7", "localhost:8000", "node17:80", "a.localhost"],
)
def test_addresses_and_local_names_are_ours(host: str) -> None:
    assert status(host) == 200


@pytest.mark.parametrize(
    "host", ["evil.example.com", "127.0.0.1.example.com:8000", "localhost.example.com", "a@b.c", ""]
)
def test_a_name_that_others_may_point_here_is_refused(host: str) -> None:
    assert status(host) == 421


def test_this_machines_own_name_is_ours() -> None:
    assert status(f"{socket.gethostname()}:8000") == 200
    assert status(socket.getfqdn()) == 200


def test_what_the_refusal_advises_works() -> None:
    answer = ask(service(), "POST", headers={"host": "Farm.Example.com:80"})
    name = answer.json()["fix"].split("--allow-host ")[1]
    assert status("farm.example.com:80", name) == 200
    assert status("farm.example.com", ".example.com") == 200
    assert status("farm.example.com", ".other.com") == 421
    assert status("farm.example.com", "*") == 200


@pytest.mark.parametrize(
    ("origin", "code"),
    [
        ("http://localhost:8000", 200),
        ("http://localhost", 403),  # another port is another's
        (FOREIGN, 403),
        ("null", 403),  # a file, or a page in a sandbox
        ("http://localhost:8000.example.com", 403),
        ("://", 403),
        ("http://[", 403),
    ],
)
def test_only_its_own_pages_may_change_anything(origin: str, code: int) -> None:
    assert status("localhost:8000", origin=origin) == code


def test_a_proxy_may_end_tls() -> None:
    assert status("shade", origin="https://shade") == 200
    assert status("shade:443", origin="https://shade") == 200
    assert status("shade:80", origin="https://shade") == 403


def test_reading_needs_no_leave_and_shows_strangers_nothing() -> None:
    answer = ask(service(), "GET", headers={"origin": FOREIGN})
    assert answer.status_code == 200
    assert "access-control-allow-origin" not in answer.headers


def test_an_allowed_origin_may_ask_and_read() -> None:
    one = service(origins=(FOREIGN,))
    preflight = {"origin": FOREIGN, "access-control-request-method": "POST"}
    assert ask(one, "OPTIONS", headers=preflight).status_code == 200
    answer = ask(one, "POST", headers={"origin": FOREIGN})
    assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (200, FOREIGN)
    assert ask(one, "POST", headers={"origin": "https://other.example.com"}).status_code == 403


@pytest.mark.parametrize(
    ("headers", "status"),
    [({"origin": FOREIGN}, 403), ({"origin": "null"}, 403), ({"host": "evil.example.com"}, 421)],
)
def test_a_foreign_websocket_never_exists(headers: dict[str, str], status: int) -> None:
    closed = websocket(headers)
    assert [message["type"] for message in closed] == ["websocket.close"]  # none was accepted
    start, body = websocket(headers, "websocket.http.response")
    assert start["status"] == status
    assert "--allow-" in json.loads(body["body"])["fix"]


@pytest.mark.parametrize("headers", [{}, {"origin": "http://testserver"}])
def test_its_own_and_programs_websockets_open(headers: dict[str, str]) -> None:
    assert [message.get("text") for message in websocket(headers)][:2] == [None, "open"]


def test_the_service_is_guarded() -> None:
    guarded, evil = create_app(Settings()), {"host": "evil.example.com"}
    assert ask(guarded, "GET", "/healthz").status_code == 200
    assert ask(guarded, "GET", "/healthz", headers=evil).status_code == 421
    form = {"headers": {"origin": FOREIGN}, "files": {"file": b"x"}}
    answer = ask(guarded, "POST", "/shade/ao", **form)
    assert (answer.status_code, answer.json()["type"][-14:]) == (403, "foreign-origin")
    allowed = create_app(Settings(hosts=["evil.example.com"], origins=[FOREIGN]))
    assert ask(allowed, "GET", "/healthz", headers=evil).status_code == 200
    assert ask(allowed, "POST", "/shade/ao", **form).json()["type"][-14:] != "foreign-origin"
