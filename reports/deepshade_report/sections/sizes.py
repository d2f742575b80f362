"""Cost against size and against background: the sections `sizes` and `background`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from deepshade.machine import memory_bytes
from deepshade_report import frames
from deepshade_report.context import Context
from deepshade_report.sections.service import serving
from deepshade_report.server import Reply, request_path
from deepshade_report.statistics import ratio, significant, spread
from deepshade_report.timing import visits

GIB = 2**30
_SQUARES = (64, 128, 256, 512, 1024, 2048, 4096, 8192)
_FOUR_K = (2160, 3840)
_HUGE = 24e6  # pixels from which on once is enough
_HUGE_NEEDS = 15 * GIB  # for the service and the picture, here and there, at 8192 x 8192
_SECONDS = 35.0
_SMALL_MEMORY = "1G"

_SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)
_SHAPES = ("sky", "object")
_WARM = 6  # untimed requests of each body; engines prepare for sizes that come often
_REST = 20.0  # seconds that this may take after them


def sizes(context: Context) -> dict[str, Any]:
    """Time, and memory above idle, of pictures from 64 x 64 to 8192 x 8192, in a fresh service.

    The fastest bundle. 3840 x 2160 is shaded once more by a service that may use 1 GiB only.
    """
    view = frames.fullest(context.held_out)
    shapes = [(side, side) for side in _SQUARES] + [(frames.HEIGHT, frames.WIDTH), _FOUR_K]
    shapes = sorted(shapes, key=lambda shape: shape[0] * shape[1])
    left_out = ""
    if context.quick:
        shapes = [shape for shape in shapes if shape[0] * shape[1] <= 1024**2]
        left_out = "a quick report ends at 1024 x 1024"
    elif memory_bytes() < _HUGE_NEEDS:
        shapes = shapes[:-1]
        left_out = f"8192 x 8192 needs a machine of {_HUGE_NEEDS // GIB} GiB"
    with tempfile.TemporaryDirectory(prefix="deepshade-report-") as folder:
        bodies = {}
        for number, shape in enumerate(shapes):
            context.advance(0.15 * number / len(shapes), f"making {_text(shape)}")
            path = Path(folder) / f"{_text(shape)}.exr"
            path.write_bytes(frames.large_body(view, *shape))
            bodies[shape] = path
        rows, bundle, backend = _shaded(context, bodies, ())
        if _FOUR_K in bodies:
            small = {shape: bodies[shape] for shape in ((frames.HEIGHT, frames.WIDTH), _FOUR_K)}
            rows += _shaded(context, small, ("--memory", _SMALL_MEMORY))[0]
    return {"bundle": bundle, "backend": backend, "left_out": left_out, "rows": rows}


def _shaded(
    context: Context, bodies: dict[tuple[int, int], Path], options: tuple[str, ...]
) -> tuple[list[dict[str, Any]], str, str]:
    from deepshade_service.config import default_memory
    from deepshade_service.memory import parse_size

    memory = parse_size(options[1]) if options else default_memory()
    bundle = context.served[0]
    first = bodies.get((frames.HEIGHT, frames.WIDTH)) or next(iter(bodies.values()))
    with serving(context, options) as server:
        connection = server.connect()
        content = first.read_bytes()
        path = request_path(connection, context.effect, bundle.name, content)
        backend = connection.shade(path, content).backend
        idle = server.settle(1.0 if context.quick else 3.0)
        rows: dict[tuple[int, int], dict[str, list[float]]] = {
            shape: {"server": [], "client": [], "peak": []} for shape in bodies
        }
        facts: dict[tuple[int, int], Reply] = {}
        pace = context.pace(_SECONDS, fewest=3, most=12)
        for share, shape in visits(list(bodies), pace):
            row = rows[shape]
            if shape[0] * shape[1] > _HUGE and row["server"]:
                continue
            context.advance(0.15 + 0.85 * share, f"{_text(shape)} {' '.join(options)}")
            content = bodies[shape].read_bytes()
            if shape[0] * shape[1] < _HUGE:
                connection.shade(path, content)
                server.settle(0.3)
            known = server.forget_peak()
            reply = connection.shade(path, content)
            row["server"].append(reply.server)
            row["client"].append(reply.milliseconds)
            if known and server.peak:
                row["peak"].append(max(0, server.peak - idle))
            facts[shape] = reply
        after = server.settle(1.0 if context.quick else 3.0)
        connection.close()
    return (
        [
            {
                "width": shape[1],
                "height": shape[0],
                "megapixels": significant(shape[0] * shape[1] / 1e6),
                "memory_setting": memory,
                "body_bytes": bodies[shape].stat().st_size,
                "server_ms": spread(row["server"]),
                "client_ms": spread(row["client"]),
                "ms_per_megapixel": significant(
                    spread(row["server"])["median"] / (shape[0] * shape[1] / 1e6)
                ),
                "stages_ms": facts[shape].stages,
                "chosen": server.chosen,
                "tiles": facts[shape].headers.get("deepshade-tiles"),
                "peak_above_idle": int(max(row["peak"])) if row["peak"] else None,
                "idle": idle,
                "idle_after": after,
            }
            for shape, row in rows.items()
        ],
        bundle.name,
        backend,
    )


def background(context: Context) -> dict[str, Any]:
    """The service's time against the share of background, beside a full frame in the same round.

    "sky" is empty from the top down, "object" empty all around a centred ellipse. Times are those
    of the steady state: every body was sent `warm_requests` times before, and what the service
    then compiled for its sizes was waited for.
    """
    view = frames.extended(frames.fullest(context.held_out), frames.HEIGHT, frames.WIDTH)
    shares = (0.0, 0.5, 1.0) if context.quick else _SHARES
    bodies = {
        (shape, share): frames.body(frames.emptied(view, share, shape))
        for shape in _SHAPES
        for share in shares
    }
    chosen = context.served[:1] if context.quick else [context.served[0], context.served[-1]]
    names = list(dict.fromkeys(bundle.name for bundle in chosen))
    full = bodies["sky", 0.0]
    rows = []
    with serving(context) as server:
        connection = server.connect()
        for index, name in enumerate(names):
            path = request_path(connection, context.effect, name, full)
            backend = connection.shade(path, full).backend
            for content in bodies.values():
                for _ in range(_WARM):
                    connection.shade(path, content)
            server.rest(_REST)
            times: dict[tuple[str, float], list[float]] = {key: [] for key in bodies}
            infer: dict[tuple[str, float], list[float]] = {key: [] for key in bodies}
            for share, key in visits(list(bodies), context.pace(20, fewest=5, most=25)):
                context.advance((index + share) / len(names), f"{name}: {key[1]:.0%} {key[0]}")
                connection.shade(path, bodies[key])
                replies = [connection.shade(path, bodies[key]) for _ in range(3)]
                reply = sorted(replies, key=lambda reply: reply.server)[1]
                times[key].append(reply.server)
                infer[key].append(reply.stages.get("infer", 0.0))
            for (shape, part), values in times.items():
                rows.append(
                    {
                        "bundle": name,
                        "backend": backend,
                        "shape": shape,
                        "share": part,
                        "total_ms": spread(values),
                        "infer_ms": spread(infer[shape, part]),
                        "of_full": ratio(values, times[shape, 0.0]),
                    }
                )
        connection.close()
    empty = significant(view.background.mean())
    return {
        "frame": [frames.WIDTH, frames.HEIGHT],
        "own_background": empty,
        "warm_requests": _WARM,
        "rows": rows,
    }


def _text(shape: tuple[int, int]) -> str:
    return f"{shape[1]}x{shape[0]}"
