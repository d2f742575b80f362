"""Who is let through: a token's bearer, or without one this machine; never another's web page."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from deepshade.errors import ConfigError
from deepshade.tokens import TokenGuard, configured, is_loopback, same

TOKEN = "a-token-of-some-length"


def status(token: str | None, method: str = "POST", path: str = "/jobs", **headers: str) -> int:
    """What a request with these headers gets; 200 is the application's."""
    sent: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message: Any) -> None:
        sent.append(message)

    async def receive() -> Any:
        return {"type": "http.request"}

    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": method, "path": path, "headers": pairs}
    guard = TokenGuard(app, token, lambda method, path: path != "/healthz")
    asyncio.run(guard(scope, receive, send))
    return int(sent[0]["status"])


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"bearer {TOKEN}", 200),
        (f"Bearer {TOKEN[:-1]}", 401),
        (f"Basic {TOKEN}", 401),
        ("Bearer", 401),
        ("", 401),
    ],
)
def test_a_token_is_asked_for(given: str, wanted: int) -> None:
    assert status(TOKEN, host="farm:8001", authorization=given) == wanted


def test_without_a_token_only_loopback_names_are_served() -> None:
    for host in ("127.0.0.1:8001", "localhost:8001", "[::1]:8001", "127.0.0.1"):
        assert status(None, host=host) == 200
    for host in ("farm:8001", "evil.example:8001", "10.0.0.1", "", "localhost.evil.example"):
        assert status(None, host=host) == 403  # a page's own name may be made to mean 127.0.0.1


def test_pages_of_other_origins_are_refused_with_or_without_a_token() -> None:
    host = "127.0.0.1:8001"
    assert status(None, host=host, origin=f"http://{host}") == 200
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999", f"http://{host}.evil"):
        assert status(None, host=host, origin=origin) == 403
        assert status(TOKEN, host=host, origin=origin, authorization=f"Bearer {TOKEN}") == 403


def test_what_isnt_guarded_is_open() -> None:
    assert status(TOKEN, method="GET", path="/healthz", host="farm") == 200


def test_tokens_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DEEPSHADE_TOKEN", raising=False)
    assert configured() is None
    monkeypatch.setenv("DEEPSHADE_TOKEN", TOKEN)
    assert configured() == TOKEN
    for bad in ("short", "with spaces in the middle", "é" * 20):
        monkeypatch.setenv("DEEPSHADE_TOKEN", bad)
        with pytest.raises(ConfigError):
            configured()


def test_equality_and_loopback() -> None:
    assert same(TOKEN, TOKEN)
    assert not same(TOKEN, TOKEN + " ")
    assert is_loopback("127.4.5.6")
    assert not is_loopback("0.0.0.0")
