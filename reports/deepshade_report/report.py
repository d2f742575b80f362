"""Measures section by section, keeps each as it is done, and writes the report."""

from __future__ import annotations

import http.client
import json
import math
import time
from collections.abc import Callable, Collection, Mapping
from datetime import UTC, datetime
from functools import partial
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade_report import page, plots
from deepshade_report.context import Context, machine
from deepshade_report.sections import (
    Sections,
    Skipped,
    comparison,
    frontier,
    methods,
    points,
    same_time,
    service,
    sizes,
    summary,
)

# name -> what measures it, and about how many seconds that takes on two cores
SECTIONS: dict[str, tuple[Callable[[Context], dict[str, Any]], int]] = {
    "error": (methods.error, 150),
    "speed": (methods.speed, 120),
    "service": (service.service, 60),
    "sizes": (sizes.sizes, 140),
    "comparison": (comparison.comparison, 10),
}

Progress = Callable[[str, float, str], None]


def measure(
    context: Context,
    *,
    only: Collection[str] = (),
    resume: bool = False,
    progress: Progress = lambda section, share, doing: None,
) -> dict[str, Any]:
    """The report, which is also written into the context's folder after each section.

    With `only`, the other sections are those measured before, if with the same settings. With
    `resume`, a section that is done already is kept.

    Raises ConfigError or DataError where there is nothing to measure: no bundle, no views.
    """
    context.served, context.views  # noqa: B018 - raise before anything is measured
    began, key = time.perf_counter(), context.key()
    wanted = [name for name in SECTIONS if not only or name in only]
    before = kept(context, key)
    sections: Sections = {}
    for name in SECTIONS:
        done = before.get(name, {}).get("status") == "done"
        if name in before and (name not in wanted or (resume and done)):
            sections[name] = before[name]
    context.measured = sections
    report = document(context, sections, key, 0.0)
    for name in [name for name in wanted if name not in sections]:
        context.advance = partial(progress, name)
        context.advance(0.0, "")
        sections[name] = _one(context, name)
        progress(name, 1.0, "")
        ordered = {name: sections[name] for name in SECTIONS if name in sections}
        report = document(context, ordered, key, time.perf_counter() - began)
        write(context, report)
    return report


def kept(context: Context, key: str) -> Sections:
    """The sections of the report that is there, if it was measured with the same settings."""
    try:
        found = json.loads((context.out / "report.json").read_text("utf-8"))
        return dict(found["sections"]) if found["key"] == key else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _one(context: Context, name: str) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        figures = SECTIONS[name][0](context)
    except (Skipped, DeepshadeError, OSError, http.client.HTTPException) as error:
        return {"status": "skipped", "reason": f"{error} {getattr(error, 'fix', '')}".strip()}
    seconds = round(time.perf_counter() - start, 1)
    return {"status": "done", "seconds": seconds, "data": finite(figures)}


def document(context: Context, sections: Sections, key: str, seconds: float) -> dict[str, Any]:
    """The report as JSON values."""
    return {
        "format": "deepshade-report",
        "version": 2,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "seconds": round(seconds, 1),
        "key": key,
        "machine": machine(),
        "options": {
            "effect": context.effect,
            "models": str(context.models),
            "data": str(context.data),
            "paper": str(context.paper) if context.paper else None,
            "threads": context.threads,
            "quick": context.quick,
            "views": context.max_views,
        },
        "summary": summary(sections),
        "same_time": same_time(sections),
        "frontier": [point.id for point in frontier(points(sections))],
        "sections": sections,
    }


def write(context: Context, report: dict[str, Any]) -> None:
    """report.json, the plots as PNG, and index.html, each replaced as a whole."""
    context.out.mkdir(parents=True, exist_ok=True)
    for name, plot in plots.PLOTS.items():
        target = context.out / f"{name}.png"
        target.unlink(missing_ok=True)  # of an earlier report
        with plots.themed():
            if (drawn := plot(report["sections"], context.effect)) is not None:
                target.write_bytes(plots.png(drawn))
    names = (*plots.PLOTS, "comparison")
    pictures = {name: context.out / f"{name}.png" for name in names}
    images = {name: path.read_bytes() for name, path in pictures.items() if path.exists()}
    with replacing(context.out / "report.json") as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", "utf-8")
    with replacing(context.out / "index.html") as temporary:
        temporary.write_text(page.render(report, images), "utf-8")


def finite(value: Any) -> Any:
    """The same data as JSON knows it: tuples as lists, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
