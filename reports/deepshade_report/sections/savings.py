"""What the planner saves on real views, and what that costs: the section `savings`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, metrics
from deepshade.bundles import Bundle
from deepshade.engines import Backend, Engine, load_engine
from deepshade.gbuffer import load_gbuffer
from deepshade_report import frames
from deepshade_report.context import Context
from deepshade_report.method import View
from deepshade_report.sections.service import serving
from deepshade_report.server import Connection, Reply, request_path
from deepshade_report.statistics import significant, spread
from deepshade_report.store import Skipped
from deepshade_report.subjects import REFERENCE, stacked
from deepshade_report.timing import alternate

_RUNS = 3  # of each thing for each view, of which the middle one counts
_EXTRA = 18  # channels beside the six that are read, as renderers write them


def savings(context: Context) -> dict[str, Any]:
    """Every held-out view through the service and, on the same backend, whole and unskipped.

    Times are those of the backend that the service chooses. What skipping changes is measured in
    fp32, where nothing but the skipping differs.
    """
    views = context.held_out
    chosen = [context.served[0]]
    if not context.quick and len(context.served) > 1:
        chosen.append(context.served[-1])
    rows = []
    with serving(context) as server:
        connection = server.connect()
        for index, bundle in enumerate(chosen):
            pair: _Pair | None = None
            for number, view in enumerate(views):
                share = (index + number / len(views)) / len(chosen)
                context.advance(0.9 * share, f"{bundle.name}, view {number + 1} of {len(views)}")
                body = frames.body(view)
                if pair is None:
                    pair = _Pair.of(context, connection, bundle, body)
                rows.append({"bundle": bundle.name, "view": number, **pair.row(view, body)})
        connection.close()
    context.advance(0.95, "channels")
    return {
        "views": len(views),
        "rows": rows,
        "summary": [_summary(b.name, [r for r in rows if r["bundle"] == b.name]) for b in chosen],
        "channels": _channels(context, views[0], context.served[0]),
    }


@dataclass
class _Pair:
    """The service, and the bare network in the same precision without a planner."""

    connection: Connection
    path: str
    exact_path: str
    bundle: Bundle
    engine: Engine
    exact: Engine

    @classmethod
    def of(cls, context: Context, connection: Connection, bundle: Bundle, body: bytes) -> _Pair:
        path = request_path(connection, context.effect, bundle.name, body)
        backend = connection.shade(path, body).backend
        exact_path = f"{path}&engine={REFERENCE.engine}&precision={REFERENCE.precision}"
        if connection.ask("POST", exact_path, body).status != 200:
            raise Skipped("this service can't be told its engine and precision")
        engines = []
        for one in (Backend(*backend.split("/", 1)), REFERENCE):
            engine = load_engine(bundle, one, threads=context.threads)
            engine.warm()
            engines.append(engine)
        return cls(connection, path, exact_path, bundle, *engines)

    def row(self, view: View, body: bytes) -> dict[str, Any]:
        """One view's figures."""
        plan = json.loads(self.connection.shade(f"{self.path}&explain=1", body).content)
        seen = _as_decoded(self.bundle, view, body)
        ready = stacked(self.bundle, seen)
        whole = _middle(lambda: self.engine.predict(ready))
        replies = [self.connection.shade(self.path, body) for _ in range(_RUNS + 1)][1:]
        infer = sorted(reply.stages.get("infer", 0.0) for reply in replies)[_RUNS // 2]
        total = sorted(reply.server for reply in replies)[_RUNS // 2]
        answer = _pixels(self.connection.shade(f"{self.exact_path}&half=false", body))
        height, width = view.background.shape
        full = self.exact.predict(ready)[0, 0, :height, :width]
        full = np.where(seen.background, np.float32(1), full)
        reference = view.reference
        return {
            "scene": view.scene,
            "background": significant(seen.background.mean()),
            "known": plan["pixels"]["known"],
            "tiles": plan["pixels"]["tiles"],
            "computed_share": significant(min(1.0, plan["pixels"]["share"])),
            "whole_ms": significant(whole),
            "infer_ms": significant(infer),
            "total_ms": significant(total),
            "plan_ms": significant(np.median([r.stages.get("plan", 0.0) for r in replies])),
            "of_full_ms": significant(infer / whole),
            "saved_ms": significant(whole - infer),
            "most_changed": significant(np.abs(answer - full).max()),
            "added_dssim": significant(_error(answer, reference) - _error(full, reference)),
        }


def _as_decoded(bundle: Bundle, view: View, body: bytes) -> View:
    """The view as the service sees it: decoded from the same bytes."""
    gbuffer = load_gbuffer([("", body)], bundle.inputs)
    return replace(
        view,
        normal=gbuffer.attributes["normal"],
        position=gbuffer.attributes["position"],
        background=gbuffer.background,
    )


def _summary(name: str, own: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "bundle": name,
        "views": len(own),
        "skipped_share": significant(np.mean([1 - row["computed_share"] for row in own])),
        "background": significant(np.mean([row["background"] for row in own])),
        "of_full_ms": spread([row["of_full_ms"] for row in own]),
        "saved_ms": spread([row["saved_ms"] for row in own]),
        "most_added_dssim": significant(max(row["added_dssim"] for row in own)),
        "most_changed": significant(max(row["most_changed"] for row in own)),
    }


def _channels(context: Context, view: View, bundle: Bundle) -> dict[str, Any]:
    """Reading the needed channels of a file with many, against reading all of them."""
    frame = frames.extended(view, frames.HEIGHT, frames.WIDTH)
    body = frames.body(frame, extra=_EXTRA)
    everything = list(exr.read_header(body).channels())
    wanted = [name for name in everything if name.split(".")[0] in bundle.inputs]
    tasks: dict[str, Callable[[], object]] = {
        "all": lambda: exr.read(body),
        "read": lambda: exr.read(body, channels=wanted),
    }
    times = alternate(tasks, context.pace(4, fewest=7, most=20))
    return {
        "in_file": len(everything),
        "read": len(wanted),
        "body_bytes": len(body),
        "all_ms": spread(times["all"]),
        "read_ms": spread(times["read"]),
    }


def _middle(task: Callable[[], object]) -> float:
    """Milliseconds of the middle one of a few runs, after an untimed one."""
    task()
    runs = []
    for _ in range(_RUNS):
        start = time.perf_counter()
        task()
        runs.append(1e3 * (time.perf_counter() - start))
    return sorted(runs)[_RUNS // 2]


def _pixels(reply: Reply) -> NDArray[np.float32]:
    return exr.read(reply.content).pixels["Y"]


def _error(image: NDArray[np.float32], reference: NDArray[np.float32]) -> float:
    return metrics.dssim(np.clip(image, 0, 1), np.clip(reference, 0, 1))
