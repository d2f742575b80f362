"""What was measured, by section; the points, frontier and comparisons that follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from deepshade.engines import REFERENCE
from deepshade_report.method import NETWORK, PAPER, PAPER_NETWORK
from deepshade_report.view import MEGAPIXELS

Sections = dict[str, Any]  # {"status": "done", "data": figures} or "skipped" with a "reason", each


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
    settings: dict[str, Any]
    quartiles: tuple[float, float] = (0.0, 0.0)  # of the milliseconds
    of_trivial: float = 0.0  # the error as a share of the trivial answer's
    standard_error: float | None = None  # of the error, over views
    relative: float | None = None  # of light: SMAPE, unclipped

    @property
    def milliseconds(self) -> float:
        """At 768 x 512."""
        return self.cost * MEGAPIXELS

    @property
    def backend(self) -> str:
        """ "openvino/bf16" of a network."""
        return f"{self.settings.get('engine')}/{self.settings.get('precision')}"


def data(sections: Sections, name: str) -> dict[str, Any]:
    """A section's figures, empty if it wasn't measured."""
    return sections.get(name, {}).get("data") or {}


def rows(sections: Sections, name: str) -> list[dict[str, Any]]:
    """A section's rows, none if it wasn't measured."""
    return list(data(sections, name).get("rows", ()))


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
            errors[row["id"]].get("standard_error"),
            errors[row["id"]].get("relative"),
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
        if own[0].family == NETWORK:
            chosen[name] = own[0]
        elif own[0].family == PAPER_NETWORK:
            chosen[name] = next((p for p in own if p.backend == str(REFERENCE)), own[0])
        else:
            chosen[name] = min(own, key=lambda point: point.error)
    return chosen


def title(name: str) -> str:
    """What a page calls a method."""
    return "the paper's network" if name == PAPER else name


def _defaults(found: Sequence[Point]) -> list[Point]:
    """The networks as they run by default, the fastest first."""
    own = [p for p in standing_for(found).values() if p.family in (NETWORK, PAPER_NETWORK)]
    return sorted(own, key=lambda point: point.cost)


def summary(sections: Sections) -> list[dict[str, Any]]:
    """One line for each network as it runs by default, the fastest first.

    `like_for_like` is how much faster it is than the paper's network on the same engine, in the
    same precision: other ratios mix what the network and what the engine gains.
    """
    found = points(sections)
    paper = {point.backend: point for point in found if point.family == PAPER_NETWORK}
    table = []
    for point in _defaults(found):
        beside = paper.get(point.backend)
        table.append(
            {
                "name": title(point.name),
                "backend": point.backend,
                "ms": point.milliseconds,
                "dssim": point.error,
                "of_trivial": point.of_trivial,
                "like_for_like": beside and beside.cost / point.cost,
                "less_error": beside and 1 - point.error / beside.error,
            }
        )
    return table


def same_time(sections: Sections) -> list[dict[str, Any]]:
    """For each network's time, the least error that each method reaches within it, and with what.

    The paper's figure 6 as a table. A method takes part by its best settings that fit; None where
    none does.
    """
    found = points(sections)
    table = []
    for budget in _defaults(found):
        fitting = [point for point in found if point.cost <= budget.cost]
        reached: dict[str, Any] = dict.fromkeys(point.name for point in found)
        for best in sorted(fitting, key=lambda point: -point.error):  # the least error comes last
            reached[best.name] = {"id": best.id, "dssim": best.error, "ms": best.milliseconds}
        table.append({"budget": title(budget.name), "ms": budget.milliseconds, "reached": reached})
    return table
