"""The report's page: one HTML file with everything inside it, for light and dark screens."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from deepshade_report import derived, style
from deepshade_report.sections import Sections, default_backend, network_row, rows

# What would shorten each stage of a request, for the note under the latency plot.
CUTS = {
    "decode": "sending only the channels that are read, ZIPS or no compression on a fast network,"
    " or depth instead of positions",
    "plan": "a coarser grid of the planner",
    "encode": "?compression=none or zips, or a PNG where 8 bits are enough",
    "transport": "a client on the same machine or a persistent connection",
}

_NONE = "\N{EN DASH}"

_BUSY = 0.1  # of the CPUs' time; from here on the page warns

NAMES = {
    "error": "Error on held-out views",
    "speed": "Speed of every method",
    "service": "Where a request's time goes",
    "clients": "Many clients",
    "sizes": "From 64 x 64 to 8192 x 8192",
    "background": "Background",
    "savings": "Only what a scene needs",
    "gpu": "GPU",
    "comparison": "One real view",
}


def render(report: Mapping[str, Any], drawn: Mapping[str, str], picture: bytes | None) -> str:
    """The page of a whole report.

    `drawn` holds SVG texts by the plots' names; `picture` is the comparison's PNG. Everything
    that was measured is escaped, and nothing is loaded from elsewhere.
    """
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"ms": _ms, "dssim": _dssim, "mib": _mib, "percent": _percent}
    template = files("deepshade_report").joinpath("page.html").read_text("utf-8")
    sections: Sections = report["sections"]
    busy = max((section.get("busy_before") or 0.0 for section in sections.values()), default=0.0)
    encoded = base64.b64encode(picture).decode() if picture else None
    return environment.from_string(template).render(
        report=report,
        machine=report["machine"],
        sections=sections,
        names=NAMES,
        svg={name: Markup(text) for name, text in drawn.items()},
        picture=encoded,
        targets=report["targets"],
        summary=summary(sections),
        points=_table(sections),
        same_time=report["same_time"],
        cuts=CUTS,
        theme=Markup(_theme()),
        busy=busy if busy > _BUSY else None,
        data={
            name: section["data"]
            for name, section in sections.items()
            if section.get("status") == "done"
        },
    )


def summary(sections: Sections) -> list[dict[str, Any]]:
    """One line for each network on the backend it has by default, the fastest first."""
    paper_error, paper_speed = (network_row(sections, part, "paper") for part in ("error", "speed"))
    names = [row["name"] for row in rows(sections, "speed", family="network")]
    table = []
    for name in [*dict.fromkeys(names), "paper"]:
        error, speed = (network_row(sections, part, name) for part in ("error", "speed"))
        if not error or not speed:
            continue
        table.append(
            {
                "name": "the paper's network" if name == "paper" else name,
                "backend": "onnxruntime/fp32"
                if name == "paper"
                else default_backend(sections, name),
                "ms": speed["ms"]["median"],
                "ms_per_megapixel": speed["ms_per_megapixel"],
                "dssim": error["dssim"],
                "ssim": error["ssim"],
                "of_trivial": error["of_trivial"],
                "faster": paper_speed["ms"]["median"] / speed["ms"]["median"]
                if paper_speed
                else None,
                "less_error": 1 - error["dssim"] / paper_error["dssim"] if paper_error else None,
            }
        )
    return sorted(table, key=lambda row: float(row["ms"]))


def _table(sections: Sections) -> list[dict[str, Any]]:
    found = derived.points(sections)
    kept = {point.id for point in derived.frontier_of(found)}
    return [
        {"point": point, "frontier": point.id in kept}
        for point in sorted(found, key=lambda point: point.cost)
    ]


def _theme() -> str:
    """The palette as CSS variables, for both colour schemes."""
    light, dark = (
        "".join(f"--{name}:{pair[k]};" for name, pair in style.PALETTE.items()) for k in (0, 1)
    )
    return (
        f":root{{color-scheme:light dark;{light}}}"
        f"@media(prefers-color-scheme:dark){{:root{{{dark}}}}}"
    )


def _ms(value: float | None) -> str:
    if value is None:
        return _NONE
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _dssim(value: float | None) -> str:
    return _NONE if value is None else f"{value:.4f}"


def _mib(value: float | None) -> str:
    return _NONE if value is None else f"{value / 2**20:,.0f}"


def _percent(value: float | None) -> str:
    return _NONE if value is None else f"{100 * value:.1f} %"
