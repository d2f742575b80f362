"""What was measured, by section, and the rows that others ask for."""

from __future__ import annotations

from typing import Any

from deepshade_report.subjects import NETWORK, PAPER_NETWORK, REFERENCE

Sections = dict[str, Any]
Row = dict[str, Any]

MOST_ADDED = 0.02


def data(sections: Sections, name: str) -> dict[str, Any] | None:
    """A section's figures, None if it wasn't measured."""
    section = sections.get(name) or {}
    found = section.get("data") if section.get("status") == "done" else None
    return found if isinstance(found, dict) else None


def rows(sections: Sections, section: str, /, **wanted: Any) -> list[Row]:
    """A section's rows with these values; none if it wasn't measured."""
    found = (data(sections, section) or {}).get("rows", [])
    return [row for row in found if all(row.get(key) == value for key, value in wanted.items())]


def backend_of(row: Row) -> str:
    """ "openvino/bf16" of a network's row."""
    settings = row["settings"]
    return f"{settings.get('engine')}/{settings.get('precision')}"


def default_backend(sections: Sections, name: str) -> str | None:
    """What a bundle runs on unless it is told otherwise.

    What the service's answers named; where no service was measured, the fastest backend that adds
    at most 2 % to the error in fp32.
    """
    served = rows(sections, "service", bundle=name)
    if served:
        return str(served[0]["backend"])
    errors = {
        backend_of(row): float(row["dssim"])
        for row in rows(sections, "error", name=name, family=NETWORK)
    }
    times = {
        backend_of(row): float(row["ms"]["median"])
        for row in rows(sections, "speed", name=name, family=NETWORK)
    }
    exact = errors.get(str(REFERENCE))
    fit = [
        backend
        for backend in times
        if exact is None or errors.get(backend, exact) <= (1 + MOST_ADDED) * exact
    ]
    return min(fit, key=lambda backend: times[backend]) if fit else None


def network_row(sections: Sections, section: str, name: str) -> Row | None:
    """The row of a bundle on its default backend, or of the paper's network in fp32."""
    paper = name == "paper"
    backend = str(REFERENCE) if paper else default_backend(sections, name)
    family = PAPER_NETWORK if paper else NETWORK
    for row in rows(sections, section, name=name, family=family):
        if backend_of(row) == backend:
            return row
    return None


def best_rival(sections: Sections, word: str) -> Row | None:
    """The settings with the least error of the methods with `word` in their name."""
    found = [
        row
        for row in rows(sections, "error")
        if row["family"] not in (NETWORK, PAPER_NETWORK) and word in row["name"].lower()
    ]
    return min(found, key=lambda row: float(row["dssim"]), default=None)
