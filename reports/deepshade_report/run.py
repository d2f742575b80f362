"""Measuring section by section, keeping each as it is done, and writing the report."""

from __future__ import annotations

import http.client
import time
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade_report import derived, page, plots, style
from deepshade_report.context import Context, busy_share, machine
from deepshade_report.sections import Sections
from deepshade_report.store import FORMAT, VERSION, Section, Skipped, Store, finite, write_json
from deepshade_report.targets import targets

# name -> about how many seconds it takes on two cores, for the progress bar
SECTIONS = {
    "error": 150,
    "speed": 120,
    "service": 60,
    "clients": 80,
    "sizes": 140,
    "background": 50,
    "savings": 50,
    "gpu": 30,
    "comparison": 10,
}

Progress = Callable[[str, float, str], None]


def measure(
    context: Context,
    *,
    only: Collection[str] = (),
    resume: bool = False,
    progress: Progress = lambda section, share, doing: None,
) -> dict[str, Any]:
    """Measure what is asked for and write the report into the context's folder.

    With `only`, the other sections are those measured before, if with the same settings. With
    `resume`, a section that is done already is kept. When anything breaks in, Ctrl-C too, the
    report of what there is so far is written first. Returns the report.
    """
    began = time.perf_counter()
    store = Store(context.out, context.key())
    sections: Sections = {}
    names = list(SECTIONS)
    wanted = [name for name in names if not only or name in only]
    for name in names:
        kept = store.load(name) if resume or name not in wanted else None
        if kept and (kept["status"] == "done" or name not in wanted):
            sections[name] = kept
    try:
        for name in [name for name in wanted if name not in sections]:
            context.advance = partial(progress, name)
            context.advance(0.0, "")
            sections[name] = _one(context, store, name, sections)
            progress(name, 1.0, "")
    except BaseException:
        write(context, sections, time.perf_counter() - began, partial_=True)
        raise
    sections = {name: sections[name] for name in names if name in sections}
    return write(context, sections, time.perf_counter() - began)


def _one(context: Context, store: Store, name: str, sections: Sections) -> Section:
    busy = busy_share(0.2 if context.quick else 1.0)
    start = time.perf_counter()
    try:
        if name == "comparison":
            from deepshade_report.sections.comparison import PICTURE, comparison

            found, picture = comparison(context, sections)
            _write_bytes(context.out / PICTURE, picture)
        else:
            found = _measurer(name)(context)
    except Skipped as reason:
        return store.skipped(name, str(reason))
    except (DeepshadeError, OSError, http.client.HTTPException) as error:
        return store.skipped(name, f"{error} {getattr(error, 'fix', '')}".strip())
    return store.done(name, found, time.perf_counter() - start, busy)


def _measurer(name: str) -> Callable[[Context], dict[str, Any]]:
    from deepshade_report.sections import gpu, methods, savings, service, sizes

    table: dict[str, Callable[[Context], dict[str, Any]]] = {
        "error": methods.error,
        "speed": methods.speed,
        "service": service.service,
        "clients": service.clients,
        "sizes": sizes.sizes,
        "background": sizes.background,
        "savings": savings.savings,
        "gpu": gpu.gpu,
    }
    return table[name]


def write(
    context: Context, sections: Sections, seconds: float, *, partial_: bool = False
) -> dict[str, Any]:
    """report.json, the plots as PNG, and index.html, each replaced as a whole."""
    from deepshade_report.sections.comparison import PICTURE

    context.out.mkdir(parents=True, exist_ok=True)
    report = document(context, sections, seconds, partial_=partial_)
    drawn: dict[str, str] = {}
    for name, (_, plot) in plots.PLOTS.items():
        with style.themed():
            figure = plot(sections)
            if figure is not None:
                _write_bytes(context.out / f"{name}.png", style.png(figure))
                drawn[name] = style.svg(figure, name)
            else:
                (context.out / f"{name}.png").unlink(missing_ok=True)  # of an earlier report
    shown = sections.get("comparison", {}).get("status") == "done"
    picture = context.out / PICTURE
    content = picture.read_bytes() if shown and picture.exists() else None
    write_json(context.out / "report.json", report)
    _write_bytes(context.out / "index.html", page.render(report, drawn, content).encode())
    return report


def document(
    context: Context, sections: Sections, seconds: float, *, partial_: bool = False
) -> dict[str, Any]:
    """The report as JSON values; `report.schema.json` beside this file describes it."""
    report = {
        "format": FORMAT,
        "version": VERSION,
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "seconds": round(seconds, 1),
        "partial": partial_,
        "machine": machine(),
        "options": {
            "effect": context.effect,
            "models": str(context.models),
            "data": str(context.data),
            "paper": str(context.paper) if context.paper else None,
            "threads": context.threads,
            "quick": context.quick,
            "views": context.views,
        },
        "targets": targets(sections),
        "same_time": derived.same_time(sections),
        "frontier": [point.id for point in derived.frontier_of(derived.points(sections))],
        "published": {
            "ms_per_megapixel": derived.PUBLISHED.cost,
            "dssim": derived.PUBLISHED.error,
            "source": "Nalbach et al. 2017, table 1: AO at 768x512 on a GTX 980 Ti, SSIM .729 on"
            " the authors' own test set",
        },
        "sections": sections,
    }
    result: dict[str, Any] = finite(report)
    return result


def _write_bytes(path: Path, content: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(content)
