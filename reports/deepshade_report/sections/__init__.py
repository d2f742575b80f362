"""What was measured, by section; the points, frontier and comparisons that follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from deepshade.engines import REFERENCE
from deepshade_report.method import NETWORK, PAPER, PAPER_NETWORK
from deepshade_report.view import MEGAPIXELS

Sections = dict[str, Any]
Row = dict[str, Any]


class Skipped(Exception):
    """A section can't be measured here; the message says why, for the page."""


@dataclass(frozen=True)
class Point:
    """One method with its settings: milliseconds per megapixel (`cost`) and DSSIM (`error`)."""

    id: str
    name: str
    family: str
    cost: float
    error: float
    settings: dict[str, Any] = field(default_factory=dict)
    quartiles: tuple[float, float] = (0.0, 0.0)
    of_trivial: float = 0.0

    @property
    def milliseconds(self) -> float:
        """At 768 x 512."""
        return self.cost * MEGAPIXELS

    @property
    def backend(self) -> str:
        """ "openvino/bf16" of a network."""
        return f"{self.settings.get('engine')}/{self.settings.get('precision')}"


def data(sections: Sections, name: str) -> dict[str, Any] | None:
    """A section's figures, None if it wasn't measured."""
    section = sections.get(name) or {}
    found = section.get("data") if section.get("status") == "done" else None
    return found if isinstance(found, dict) else None


def rows(sections: Sections, section: str, /, **wanted: Any) -> list[Row]:
    """A section's rows with these values; none if it wasn't measured."""
    found = (data(sections, section) or {}).get("rows", [])
    return [row for row in found if all(row.get(key) == value for key, value in wanted.items())]


def points(sections: Sections) -> list[Point]:
    """Every method whose error and speed both were measured."""
    errors = {row["id"]: row for row in rows(sections, "error")}
    return [
        Point(
            row["id"],
            row["name"],
            row["family"],
            row["ms_per_megapixel"],
            errors[row["id"]]["dssim"],
            row["settings"],
            tuple(row["ms"]["quartiles"]),
            errors[row["id"]]["of_trivial"],
        )
        for row in rows(sections, "speed")
        if row["id"] in errors
    ]


def frontier(found: Sequence[Point]) -> list[Point]:
    """The points that no other beats, fastest first.

    One is beaten by another that is no worse in both and better in one; of equals the first counts.
    """
    kept: list[Point] = []
    for point in sorted(found, key=lambda point: (point.cost, point.error)):
        if not kept or point.error < kept[-1].error:
            kept.append(point)
    return kept


def standing_for(found: Sequence[Point]) -> dict[str, Point]:
    """For each method the point that its name is written at.

    A network's is the one on the engine and precision that it runs on by default, which is the
    first that was measured; the paper's network's is that in fp32, as its authors ran it; of other
    methods the one with the least error.
    """
    chosen: dict[str, Point] = {}
    for name in dict.fromkeys(point.name for point in found):
        own = [point for point in found if point.name == name]
        exact = [point for point in own if point.backend == str(REFERENCE)]
        if own[0].family == NETWORK:
            chosen[name] = own[0]
        elif own[0].family == PAPER_NETWORK and exact:
            chosen[name] = exact[0]
        else:
            chosen[name] = min(own, key=lambda point: point.error)
    return chosen


def title(name: str) -> str:
    """What a page calls a method."""
    return "the paper's network" if name == PAPER else name


def summary(sections: Sections) -> list[dict[str, Any]]:
    """One line for each network as it runs by default, the fastest first.

    `like_for_like` is how much faster it is than the paper's network on the same engine, in the
    same precision: other ratios mix what the network and what the engine gains.
    """
    found = points(sections)
    named = {p.name: p for p in standing_for(found).values() if p.family == NETWORK}
    paper = {point.backend: point for point in found if point.family == PAPER_NETWORK}
    if paper:
        named[PAPER] = standing_for(found)[PAPER]
    table = []
    for name, point in named.items():
        beside = paper.get(point.backend)
        table.append(
            {
                "name": title(name),
                "backend": point.backend,
                "ms": point.milliseconds,
                "ms_per_megapixel": point.cost,
                "dssim": point.error,
                "of_trivial": point.of_trivial,
                "like_for_like": beside and beside.cost / point.cost,
                "less_error": beside and 1 - point.error / beside.error,
            }
        )
    return sorted(table, key=lambda row: float(row["ms"]))


def same_time(sections: Sections) -> list[dict[str, Any]]:
    """For each network's time, the least error that each method reaches within it, and with what.

    The paper's figure 6 as a table. A method takes part by its best settings that fit; None where
    none does.
    """
    found = points(sections)
    budgets = [p for p in standing_for(found).values() if p.family in (NETWORK, PAPER_NETWORK)]
    table = []
    for budget in sorted(budgets, key=lambda point: point.cost):
        reached: dict[str, Any] = {}
        for name in dict.fromkeys(point.name for point in found):
            # a budget is the median of one method, so it fits itself in spite of rounding
            fit = [p for p in found if p.name == name and p.cost <= budget.cost * 1.001]
            best = min(fit, key=lambda point: point.error, default=None)
            reached[name] = best and {"id": best.id, "dssim": best.error, "ms": best.milliseconds}
        table.append({"budget": title(budget.name), "ms": budget.milliseconds, "reached": reached})
    return table
