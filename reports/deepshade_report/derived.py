"""What follows from the measured sections: points, the frontier, the same-time comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from deepshade_report.frames import MEGAPIXELS
from deepshade_report.sections import Sections, backend_of, default_backend, network_row, rows
from deepshade_report.statistics import frontier
from deepshade_report.subjects import NETWORK, PAPER_NETWORK


@dataclass(frozen=True)
class Point:
    """One method with its settings: milliseconds per megapixel (`cost`) and DSSIM (`error`)."""

    id: str
    name: str
    family: str
    cost: float
    error: float
    settings: dict[str, Any] = field(default_factory=dict)
    spread: tuple[float, float] = (0.0, 0.0)
    of_trivial: float = 0.0

    @property
    def milliseconds(self) -> float:
        """At 768 x 512."""
        return self.cost * MEGAPIXELS


# Table 1 of Nalbach et al. 2017: AO, SSIM .729 on its own test set, 17 ms at 768 x 512.
PUBLISHED = Point(
    "published", "the paper, GTX 980 Ti", "published", 17 / MEGAPIXELS, (1 - 0.729) / 2
)


def points(sections: Sections) -> list[Point]:
    """Every method whose error and speed both were measured."""
    errors = {row["id"]: row for row in rows(sections, "error")}
    found = []
    for row in rows(sections, "speed"):
        if error := errors.get(row["id"]):
            low, high = row["ms"]["quartiles"]
            found.append(
                Point(
                    row["id"],
                    row["name"],
                    row["family"],
                    row["ms_per_megapixel"],
                    error["dssim"],
                    row["settings"],
                    (low, high),
                    error["of_trivial"],
                )
            )
    return found


def frontier_of(found: Sequence[Point]) -> list[Point]:
    """The points that no other beats, fastest first."""
    return [found[k] for k in frontier([(point.cost, point.error) for point in found])]


def standing_for(sections: Sections, own: Sequence[Point]) -> Point:
    """The point of a method that its name is written at: the default backend, or least error."""
    if own[0].family == NETWORK:
        backend = default_backend(sections, own[0].name)
        for point in own:
            if backend_of({"settings": point.settings}) == backend:
                return point
    if own[0].family == PAPER_NETWORK:
        for point in own:
            if backend_of({"settings": point.settings}) == "onnxruntime/fp32":
                return point
    return min(own, key=lambda point: point.error)


def budgets(sections: Sections) -> list[tuple[str, float]]:
    """The times to compare at: each bundle's on its default backend, and the paper's network's."""
    names = dict.fromkeys(row["name"] for row in rows(sections, "speed", family=NETWORK))
    found = []
    for name in (*names, "paper"):
        if row := network_row(sections, "speed", name):
            label = "the paper's network" if name == "paper" else name
            found.append((label, float(row["ms"]["median"])))
    return sorted(found, key=lambda item: item[1])


def same_time(sections: Sections) -> list[dict[str, Any]]:
    """For each budget, the least error that each method reaches within it, and with what.

    A method takes part by its best settings that fit; None where none does.
    """
    found = points(sections)
    names = list(dict.fromkeys(point.name for point in found))
    table = []
    for label, budget in budgets(sections):
        reached: dict[str, Any] = {}
        for name in names:
            # a budget is the median of one method, so it fits itself in spite of rounding
            fit = [p for p in found if p.name == name and p.milliseconds <= budget * 1.001]
            best = min(fit, key=lambda point: point.error, default=None)
            reached[name] = best and {
                "id": best.id,
                "dssim": best.error,
                "ms": round(best.milliseconds, 3),
            }
        table.append({"budget": label, "ms": round(budget, 3), "reached": reached})
    return table
