"""One picture is one trace: the client's span, the request's, and its stages'."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from deepshade import tracing
from deepshade_client import Client


@pytest.fixture
def spans() -> Iterator[InMemorySpanExporter]:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    tracing.use(provider)
    yield exporter
    tracing.end()


def test_a_picture_is_one_trace(
    service: Any,
    make_exr: Callable[..., bytes],
    spans: InMemorySpanExporter,
    wait_until: Callable[..., None],
) -> None:
    with Client(str(service.client.base_url)) as client:
        client.shade("ao", make_exr(64, 64))
    names = {"ask", "POST /shade/{effect}", "decode", "plan", "infer", "encode"}
    # the client may have its answer before the request has ended
    wait_until(lambda: names <= {span.name for span in spans.get_finished_spans()})
    found = {span.name: span for span in spans.get_finished_spans()}
    assert len({span.context.trace_id for span in found.values()}) == 1
    request = found["POST /shade/{effect}"]
    for stage in ("decode", "plan", "infer", "encode"):  # across the threads that do them
        assert found[stage].parent.span_id == request.context.span_id, stage
