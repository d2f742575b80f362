"""The service's time and memory against resolution: the section `sizes`."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from deepshade.machine import memory_bytes
from deepshade.timing import alternate, significant, spread
from deepshade_report.context import Context
from deepshade_report.server import Server
from deepshade_report.view import HEIGHT, WIDTH, body, fullest

GIB = 2**30
_SQUARES = (64, 128, 256, 512, 1024, 2048, 4096, 8192)
_USUAL, _FOUR_K = (HEIGHT, WIDTH), (2160, 3840)
_HUGE_NEEDS = 15 * GIB  # for the service and the picture, here and there, at 8192 x 8192
_SECONDS = 35.0
_SMALL_MEMORY = "1G"

Shape = tuple[int, int]


def sizes(context: Context) -> dict[str, Any]:
    """Time, and memory above idle, of pictures from 64 x 64 to 8192 x 8192, by the fastest bundle.

    3840 x 2160 is shaded once more by a service that may use 1 GiB only.
    """
    view, left_out = fullest(context.views), ""
    shapes = [(side, side) for side in _SQUARES] + [_USUAL, _FOUR_K]
    shapes.sort(key=lambda shape: shape[0] * shape[1])
    if context.quick:
        shapes = [shape for shape in shapes if shape[0] * shape[1] <= 1024**2]
        left_out = "a quick report ends at 1024 x 1024"
    elif memory_bytes() < _HUGE_NEEDS:
        shapes.pop()
        left_out = f"8192 x 8192 needs a machine of {_HUGE_NEEDS // GIB} GiB"
    with tempfile.TemporaryDirectory(prefix="deepshade-report-") as name:
        folder = Path(name)
        for shape in shapes:
            context.advance(0.0, f"making {_text(shape)}")
            (folder / _text(shape)).write_bytes(body(view, *shape, grain=True))
        rows = _shaded(context, folder, shapes)
        if _FOUR_K in shapes:
            rows += _shaded(context, folder, (_USUAL, _FOUR_K), _SMALL_MEMORY)
    return {"bundle": context.served[0].name, "left_out": left_out, "rows": rows}


def _shaded(
    context: Context, folder: Path, shapes: Iterable[Shape], memory: str | None = None
) -> list[dict[str, Any]]:
    path = f"/shade/{context.effect}?bundle={context.served[0].name}&trust=1"
    with Server(context.models, ("--memory", memory) if memory else ()) as server:
        server.shade(path, (folder / _text(_USUAL)).read_bytes())
        idle = server.settle(1.0 if context.quick else 3.0)
        files = {_text(shape): folder / _text(shape) for shape in shapes}
        tasks = {size: partial(_shade, server, path, file, idle) for size, file in files.items()}
        pace = context.pace(_SECONDS, min_rounds=2, max_rounds=12)
        found = alternate(tasks, pace, advance=context.advance)
    rows = []
    for height, width in shapes:
        size, megapixels = _text((height, width)), height * width / 1e6
        figures = found[size]
        server_ms = spread(figures["total"])
        rows.append(
            {
                "width": width,
                "height": height,
                "memory": memory,
                "body_bytes": files[size].stat().st_size,
                "server_ms": server_ms,
                "client_ms": spread(figures["client"]),
                "ms_per_megapixel": significant(server_ms["median"] / megapixels),
                "tiles": int(figures["tiles"][-1]),
                "peak_above_idle": int(max(figures["peak"])) if "peak" in figures else None,
            }
        )
    return rows


def _shade(server: Server, path: str, file: Path, idle: int) -> dict[str, float]:
    """Figures of a request, and the most memory above idle that it took, where that is known."""
    content = file.read_bytes()
    server.settle(0.1)
    known = server.forget_peak()
    figures = server.shade(path, content).figures
    return figures | ({"peak": max(0.0, server.peak - idle)} if known else {})


def _text(shape: Shape) -> str:
    return f"{shape[1]}x{shape[0]}"
