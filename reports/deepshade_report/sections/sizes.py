"""The service's time and memory against resolution: the section `sizes`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deepshade.machine import memory_bytes
from deepshade_report.context import Context
from deepshade_report.sections.service import request_path
from deepshade_report.server import STAGES, Server
from deepshade_report.timing import alternate, significant, spread
from deepshade_report.view import HEIGHT, WIDTH, body, fullest

GIB = 2**30
_SQUARES = (64, 128, 256, 512, 1024, 2048, 4096, 8192)
_FOUR_K = (2160, 3840)
_HUGE_NEEDS = 15 * GIB  # for the service and the picture, here and there, at 8192 x 8192
_SECONDS = 35.0
_SMALL_MEMORY = "1G"

Shape = tuple[int, int]


def sizes(context: Context) -> dict[str, Any]:
    """Time, and memory above idle, of pictures from 64 x 64 to 8192 x 8192, by the fastest bundle.

    3840 x 2160 is shaded once more by a service that may use 1 GiB only.
    """
    view, left_out = fullest(context.views), ""
    shapes = [(side, side) for side in _SQUARES] + [(HEIGHT, WIDTH), _FOUR_K]
    shapes.sort(key=lambda shape: shape[0] * shape[1])
    if context.quick:
        shapes = [shape for shape in shapes if shape[0] * shape[1] <= 1024**2]
        left_out = "a quick report ends at 1024 x 1024"
    elif memory_bytes() < _HUGE_NEEDS:
        shapes = shapes[:-1]
        left_out = f"8192 x 8192 needs a machine of {_HUGE_NEEDS // GIB} GiB"
    with tempfile.TemporaryDirectory(prefix="deepshade-report-") as folder:
        bodies: dict[Shape, Path] = {}
        for shape in shapes:
            context.advance(0.0, f"making {_text(shape)}")
            bodies[shape] = Path(folder) / f"{_text(shape)}.exr"
            bodies[shape].write_bytes(body(view, *shape, grain=True))
        rows = _shaded(context, bodies)
        if _FOUR_K in bodies:
            small = {shape: bodies[shape] for shape in ((HEIGHT, WIDTH), _FOUR_K)}
            rows += _shaded(context, small, _SMALL_MEMORY)
    return {"bundle": context.served[0].name, "left_out": left_out, "rows": rows}


def _shaded(
    context: Context, bodies: dict[Shape, Path], memory: str | None = None
) -> list[dict[str, Any]]:
    path = request_path(context, context.served[0])
    options = ("--memory", memory) if memory else ()
    with Server(context.models, options) as server:
        server.shade(path, bodies[HEIGHT, WIDTH].read_bytes())
        idle = server.settle(1.0 if context.quick else 3.0)
        tasks = {_text(shape): _shading(server, path, file, idle) for shape, file in bodies.items()}
        pace = context.pace(_SECONDS, min_rounds=2, max_rounds=12)
        found = alternate(tasks, pace, advance=context.advance)
    rows = []
    for (height, width), file in bodies.items():
        figures, megapixels = found[_text((height, width))], height * width / 1e6
        server_ms = spread(figures["server"])
        rows.append(
            {
                "width": width,
                "height": height,
                "megapixels": significant(megapixels),
                "memory": memory,
                "body_bytes": file.stat().st_size,
                "server_ms": server_ms,
                "client_ms": spread(figures["client"]),
                "ms_per_megapixel": significant(server_ms["median"] / megapixels),
                "stages_ms": {stage: spread(figures[stage]) for stage in STAGES},
                "tiles": int(figures["tiles"][-1]),
                "peak_above_idle": int(max(figures["peak"])) if "peak" in figures else None,
            }
        )
    return rows


def _shading(server: Server, path: str, file: Path, idle: int) -> Callable[[], object]:
    def shade() -> dict[str, float]:
        content = file.read_bytes()
        server.settle(0.1)
        known = server.forget_peak()
        reply = server.shade(path, content)
        figures = {**reply.stages, "server": reply.server, "client": reply.milliseconds}
        figures["tiles"] = float(reply.headers["deepshade-tiles"])
        if known and server.peak:
            figures["peak"] = float(max(0, server.peak - idle))
        return figures

    return shade


def _text(shape: Shape) -> str:
    return f"{shape[1]}x{shape[0]}"
