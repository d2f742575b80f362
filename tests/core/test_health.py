"""The health check of containers, against a server of the standard library."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from deepshade.health import main


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        sent = self.headers.get("Authorization")
        self.send_response(200 if sent == "Bearer a-token" else 401)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def url() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/readyz"
        server.shutdown()
        thread.join()


def test_it_sends_the_token(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEEPSHADE_TOKEN", "a-token")
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # not for a service beside us
    assert main([url]) == 0


def test_it_says_what_is_wrong(
    url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DEEPSHADE_TOKEN", raising=False)
    assert main([url]) == 1
    assert "401" in capsys.readouterr().err
    assert main(["http://127.0.0.1:9/"]) == 1
    assert "refused" in capsys.readouterr().err
    assert main(["nonsense"]) == 1
    assert main([]) == 2
