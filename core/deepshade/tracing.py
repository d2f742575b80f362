"""Spans of client, service and trainer (OpenTelemetry), where $OTEL_TRACES_EXPORTER asks for them.

`otlp` sends them to $OTEL_EXPORTER_OTLP_ENDPOINT (OTLP over HTTP), `console` prints them; the
other variables are OpenTelemetry's own. Without the variable nothing of it is imported. A trace is
carried from process to process by the header `traceparent` (W3C Trace Context).
"""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from typing import Any

from deepshade.errors import ConfigError

VARIABLE = "OTEL_TRACES_EXPORTER"
EXPORTERS = ("none", "otlp", "console")
_POLLS = ("/healthz", "/readyz", "/metrics")

_provider: Any = None
_tracer: Any = None

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


def begin(service: str) -> bool:
    """Record spans from now on, if the variable says so; whether it does.

    `service` is the name without $OTEL_SERVICE_NAME. Raises ConfigError for an exporter that there
    isn't, and where OpenTelemetry isn't installed.
    """
    asked = os.environ.get(VARIABLE) or EXPORTERS[0]
    if asked not in EXPORTERS:
        raise ConfigError(asked, EXPORTERS, detail=f"${VARIABLE} is {asked[:40]!r}")
    if asked == EXPORTERS[0] or _tracer is not None:
        return _tracer is not None
    try:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor, ConsoleSpanExporter

        exporter: Any = ConsoleSpanExporter()
        if asked == "otlp":
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

            exporter = OTLPSpanExporter()
    except ImportError as error:
        raise ConfigError(
            VARIABLE,
            detail=f"${VARIABLE}={asked} needs OpenTelemetry: pip install opentelemetry-sdk "
            "opentelemetry-exporter-otlp-proto-http",
        ) from error
    os.environ.setdefault("OTEL_SERVICE_NAME", service)
    provider = TracerProvider(resource=Resource.create())
    provider.add_span_processor(BatchSpanProcessor(exporter))
    use(provider)
    return True


def use(provider: Any) -> None:
    """Record spans with this provider; with None no more."""
    global _provider, _tracer
    _provider, _tracer = provider, provider and provider.get_tracer("deepshade")


def end() -> None:
    """Export what was recorded, and record no more."""
    if _provider is not None:
        _provider.shutdown()
    use(None)


@contextmanager
def span(
    name: str, *, parent: Mapping[str, str] | None = None, kind: str = "INTERNAL", **facts: Any
) -> Iterator[Any]:
    """A span around the block, or nothing where none are recorded; yields it or None.

    It belongs to the span around it, or to that of a `parent`'s `traceparent`. An exception is
    recorded with it.
    """
    if _tracer is None:
        yield None
        return
    from opentelemetry.propagate import extract
    from opentelemetry.trace import SpanKind

    context = extract(parent) if parent is not None else None
    with _tracer.start_as_current_span(
        name, context=context, kind=SpanKind[kind], attributes=facts
    ) as made:
        yield made


def carried() -> dict[str, str]:
    """The headers that carry the current span to another process; none where none are recorded."""
    headers: dict[str, str] = {}
    if _tracer is not None:
        from opentelemetry.propagate import inject

        inject(headers)
    return headers


def ids() -> dict[str, str]:
    """The current trace's and span's numbers, hexadecimal; none where none are recorded."""
    if _tracer is None:
        return {}
    from opentelemetry.trace import get_current_span

    context = get_current_span().get_span_context()
    if not context.is_valid:
        return {}
    return {"trace_id": f"{context.trace_id:032x}", "span_id": f"{context.span_id:016x}"}


class Tracing:
    """ASGI middleware: a span a request, with its method, route and status; polls have none."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, in a span."""
        if _tracer is None or scope["type"] != "http" or scope["path"] in _POLLS:
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        method = scope["method"]
        with span(method, parent=headers, kind="SERVER", **{"http.request.method": method}) as made:

            async def seen(message: MutableMapping[str, Any]) -> None:
                if message["type"] == "http.response.start":
                    made.set_attribute("http.response.status_code", message["status"])
                await send(message)

            try:
                await self._app(scope, receive, seen)
            finally:
                # the route's pattern, not the path: strangers could make up endless names
                if route := getattr(scope.get("route"), "path", ""):
                    made.update_name(f"{method} {route}")
                    made.set_attribute("http.route", route)
