"""The report's page: one HTML file with everything inside it, for light and dark screens."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from deepshade_report import plots
from deepshade_report.sections import data, points

_NONE = "\N{EN DASH}"

NAMES = {
    "error": "Error on held-out views, and speed",
    "service": "Where a request's time goes",
    "sizes": "From 64 x 64 to 8192 x 8192",
    "comparison": "One real view",
}


def render(report: Mapping[str, Any], images: Mapping[str, bytes]) -> str:
    """The page of a whole report.

    `images` are PNGs, by the plots' names and "comparison". Everything that was measured is
    escaped, and nothing is loaded from elsewhere.
    """
    from jinja2 import Environment

    environment = Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"ms": _ms, "dssim": _dssim, "mib": _mib, "percent": _percent}
    template = files("deepshade_report").joinpath("page.html").read_text("utf-8")
    sections = report["sections"]
    return environment.from_string(template).render(
        report=report,
        machine=report["machine"],
        sections=sections,
        names=NAMES,
        images={name: base64.b64encode(png).decode() for name, png in images.items()},
        points=sorted(points(sections), key=lambda point: point.cost),
        palette=plots.PALETTE,
        data={name: found for name in sections if (found := data(sections, name))},
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
