"""Spans: off without the variable, and one trace across processes with it."""

from __future__ import annotations

import asyncio
import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from deepshade import tracing
from deepshade.errors import ConfigError
from deepshade.logs import JsonFormatter


@pytest.fixture
def spans() -> Iterator[InMemorySpanExporter]:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    tracing.use(provider)
    yield exporter
    tracing.end()


def test_without_the_variable_nothing_is_imported_or_sent() -> None:
    code = """
import sys
from deepshade import tracing
assert not tracing.begin("x")
with tracing.span("a") as made:
    assert made is None and tracing.carried() == {} == tracing.ids()
assert not [name for name in sys.modules if name.startswith("opentelemetry")]
"""
    subprocess.run([sys.executable, "-c", code], check=True, env={"PYTHONPATH": ":".join(sys.path)})


def test_the_console_shows_spans_at_the_end() -> None:
    code = "from deepshade import tracing as t\nt.begin('us')\nwith t.span('a'): pass\nt.end()"
    env = {"PYTHONPATH": ":".join(sys.path), "OTEL_TRACES_EXPORTER": "console"}
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, env=env, capture_output=True, text=True
    )
    found = json.loads(done.stdout)
    assert found["name"] == "a"
    assert found["resource"]["attributes"]["service.name"] == "us"


def test_an_exporter_that_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_TRACES_EXPORTER", "consol")
    with pytest.raises(ConfigError, match="consol") as caught:
        tracing.begin("x")
    assert caught.value.fix == "did you mean 'console'?"


def test_a_request_belongs_to_its_client_s_trace(spans: InMemorySpanExporter) -> None:
    logged = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        scope["route"] = type("Route", (), {"path": "/shade/{effect}"})
        with tracing.span("decode"):
            record = logging.LogRecord("deepshade", 20, "", 1, "x", None, None)
            logged.append(json.loads(JsonFormatter().format(record)))
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(_: Any) -> None:
        pass

    with tracing.span("ask", kind="CLIENT"):
        headers = [(k.encode(), v.encode()) for k, v in tracing.carried().items()]
    scope = {"type": "http", "method": "POST", "path": "/shade/ao", "headers": headers}
    asyncio.run(tracing.Tracing(app)(scope, None, send))  # type: ignore[arg-type]
    poll = {"type": "http", "method": "GET", "path": "/healthz", "headers": []}
    asyncio.run(tracing.Tracing(app)(poll, None, send))  # type: ignore[arg-type]
    ask, decode, request, _ = spans.get_finished_spans()
    assert (ask.name, request.name) == ("ask", "POST /shade/{effect}")
    assert request.parent is not None and decode.parent is not None
    assert request.parent.span_id == ask.context.span_id
    assert decode.parent.span_id == request.context.span_id
    assert request.attributes == {
        "http.request.method": "POST",
        "http.response.status_code": 200,
        "http.route": "/shade/{effect}",
    }
    assert logged[0]["trace_id"] == f"{ask.context.trace_id:032x}"


def test_a_failure_is_kept(spans: InMemorySpanExporter) -> None:
    with pytest.raises(ValueError), tracing.span("a"):
        raise ValueError("no")
    (found,) = spans.get_finished_spans()
    assert found.events[0].attributes is not None
    assert found.events[0].attributes["exception.type"] == "ValueError"
