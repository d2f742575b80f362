"""The service from outside, stage by stage: the section `service`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from deepshade.engines import Backend, load_engine
from deepshade.timing import alternate, ratio, spread
from deepshade_report.context import Context
from deepshade_report.method import Network
from deepshade_report.server import STAGES, Server
from deepshade_report.view import HEIGHT, WIDTH, body, fullest, resized

_SECONDS = 45.0


def service(context: Context) -> dict[str, Any]:
    """Requests at 768 x 512, half ZIP in and out, against the bare network in turns.

    The bare network runs here, on the backend that the service's answers name.
    """
    view = resized(fullest(context.views))
    content = body(view)
    rows: list[dict[str, Any]] = []
    with Server(context.models) as server:
        tasks: dict[str, Callable[[], object]] = {}
        for bundle in context.served:
            path = f"/shade/{context.effect}?bundle={bundle.name}&trust=1"  # the frame is mirrored
            backend = server.shade(path, content).backend
            engine = load_engine(bundle, Backend(*backend.split("/")), threads=context.threads)
            network = Network(bundle, engine)
            network.prepare(view)
            tasks[path] = partial(_figures, server, path, content)
            tasks[bundle.name] = partial(network.shade, view)
            about = {"bundle": bundle.name, "sha256": bundle.sha256, "request": path}
            rows.append(about | {"backend": backend})
        pace = context.pace(_SECONDS, min_rounds=6, max_rounds=40)
        found = alternate(tasks, pace, advance=context.advance)
    for row in rows:
        request, network_ms = found[row["request"]], found[row["bundle"]]["ms"]
        row["bare_ms"] = spread(network_ms)
        row["total_ms"] = spread(request["total"])
        row["stages_ms"] = {stage: spread(request[stage]) for stage in (*STAGES, "transport")}
        row["ratio"] = ratio(request["total"], network_ms)
    return {"frame": [WIDTH, HEIGHT], "body_bytes": len(content), "rows": rows}


def _figures(server: Server, path: str, content: bytes) -> dict[str, float]:
    return server.shade(path, content).figures
