"""The report's page: one HTML file with everything inside it, for light and dark screens."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from deepshade_report.plots import PALETTE
from deepshade_report.sections import data, points


def render(report: Mapping[str, Any], images: Mapping[str, bytes]) -> str:
    """The page of a whole report.

    `images` are PNGs, by the plots' names and "comparison". Everything that was measured is
    escaped, and nothing is loaded from elsewhere.
    """
    from jinja2 import Environment

    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters["ms"] = _milliseconds
    template = files("deepshade_report").joinpath("page.html").read_text("utf-8")
    sections = report["sections"]
    return environment.from_string(template).render(
        report=report,
        machine=report["machine"],
        sections=sections,
        images={name: base64.b64encode(png).decode() for name, png in images.items()},
        points=sorted(points(sections), key=lambda point: point.cost),
        palette=PALETTE,
        data={name: found for name in sections if (found := data(sections, name))},
    )


def _milliseconds(value: float) -> str:
    return f"{value:.3g}" if value < 100 else f"{value:,.0f}"
