"""Measures section by section, keeps each as it is done, and writes the report."""

from __future__ import annotations

import http.client
import json
import time
from collections.abc import Callable, Collection
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

SECTIONS: dict[str, Callable[[Context], dict[str, Any]]] = {
    "error": methods.error,
    "speed": methods.speed,
    "service": service.service,
    "sizes": sizes.sizes,
    "comparison": comparison.comparison,
}


def measure(
    context: Context,
    *,
    only: Collection[str] = (),
    resume: bool = False,
    progress: Callable[[str, float, str], None] = lambda section, share, doing: None,
) -> dict[str, Any]:
    """The report, which is also written into the context's folder after each section.

    With `only`, the other sections are those measured before, if with the same settings. With
    `resume`, a section that is done already is kept.

    Raises ConfigError or DataError where there is nothing to measure: no bundle, no views.
    """
    context.served, context.views  # noqa: B018 - raise before anything is measured
    key = context.key()
    before = kept(context, key)
    again = [name for name in SECTIONS if not only or name in only]
    if resume:
        again = [name for name in again if before.get(name, {}).get("status") != "done"]
    sections = {name: found for name, found in before.items() if name not in again}
    context.measured = sections
    report = document(context, sections, key)
    for name in again:
        context.advance = partial(progress, name)
        context.advance(0.0, "")
        sections[name] = _one(context, name)
        context.advance(1.0, "")
        report = document(context, sections, key)
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
        figures = SECTIONS[name](context)
    except (Skipped, DeepshadeError, OSError, http.client.HTTPException) as error:
        return {"status": "skipped", "reason": f"{error} {getattr(error, 'fix', '')}".strip()}
    # as a file gives it back, with None for what is not finite
    plain = json.loads(json.dumps(figures), parse_constant=lambda _: None)
    return {"status": "done", "seconds": round(time.perf_counter() - start, 1), "data": plain}


def document(context: Context, sections: Sections, key: str) -> dict[str, Any]:
    """The report as JSON values."""
    return {
        "format": "deepshade-report",
        "version": 2,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "key": key,
        "machine": machine(),
        "options": context.options(),
        "summary": summary(sections),
        "same_time": same_time(sections),
        "frontier": [point.id for point in frontier(points(sections))],
        "sections": {name: sections[name] for name in SECTIONS if name in sections},
    }


def write(context: Context, report: dict[str, Any]) -> None:
    """report.json, speed-error.png and index.html."""
    context.out.mkdir(parents=True, exist_ok=True)
    images: dict[str, bytes] = {}
    if drawn := plots.speed_error(report["sections"], context.effect):
        images["speed-error"] = drawn
        (context.out / "speed-error.png").write_bytes(drawn)
    if (picture := context.out / comparison.PICTURE).exists():
        images["comparison"] = picture.read_bytes()
    with replacing(context.out / "report.json") as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", "utf-8")
    with replacing(context.out / "index.html") as temporary:
        temporary.write_text(page.render(report, images), "utf-8")
