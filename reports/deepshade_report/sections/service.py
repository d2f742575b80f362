"""The service from outside, stage by stage: the section `service`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from deepshade.bundles import Bundle
from deepshade.engines import Backend, load_engine
from deepshade_report.context import Context
from deepshade_report.method import Network
from deepshade_report.server import STAGES, Server
from deepshade_report.timing import alternate, ratio, spread
from deepshade_report.view import HEIGHT, WIDTH, View, body, fullest, resized

_SECONDS = 45.0


def service(context: Context) -> dict[str, Any]:
    """Requests at 768 x 512, half ZIP in and out, against the bare network in turns.

    The bare network runs here, on the backend that the service's answers name.
    """
    view = resized(fullest(context.views))
    content = body(view)
    rows = []
    with Server(context.models) as server:
        tasks: dict[str, Callable[[], object]] = {}
        about: dict[str, dict[str, Any]] = {}
        for bundle in context.served:
            path = request_path(context, bundle)
            backend = server.shade(path, content).backend
            tasks[bundle.name] = _asking(server, path, content)
            tasks[f"{bundle.name}, bare"] = _bare(bundle, backend, view, context.threads)
            about[bundle.name] = {"sha256": bundle.sha256, "request": path, "backend": backend}
        pace = context.pace(_SECONDS, min_rounds=6, max_rounds=40)
        found = alternate(tasks, pace, advance=context.advance)
    for name, facts in about.items():
        request, network = found[name], found[f"{name}, bare"]["ms"]
        rows.append(
            {
                "bundle": name,
                **facts,
                "bare_ms": spread(network),
                "total_ms": spread(request["total"]),
                "stages_ms": {stage: spread(request[stage]) for stage in (*STAGES, "transport")},
                "ratio": ratio(request["total"], network),
            }
        )
    return {"frame": [WIDTH, HEIGHT], "body_bytes": len(content), "rows": rows}


def request_path(context: Context, bundle: Bundle) -> str:
    """How to ask the service for a bundle."""
    return f"/shade/{context.effect}?bundle={bundle.name}"


def _asking(server: Server, path: str, content: bytes) -> Callable[[], object]:
    def ask() -> dict[str, float]:
        reply = server.shade(path, content)
        rest = reply.milliseconds - reply.server
        return {**reply.stages, "total": reply.server, "transport": rest}

    return ask


def _bare(bundle: Bundle, backend: str, view: View, threads: int) -> Callable[[], object]:
    engine = load_engine(bundle, Backend(*backend.split("/", 1)), threads=threads)
    engine.warm()
    network = Network(bundle, engine, bundle.name)
    network.prepare(view)
    return lambda: network.shade(view)
