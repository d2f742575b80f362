"""More kinds of scenes for the same number of views (the paper's figure 12).

Each view shows a scene of its own; the number of families of procedural scenes differs. All are
tested on the same views, which come from all families.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from deepshade_report.plots import plain
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import curves, plot
from deepshade_report.studies.common.learning import recipe, trained
from deepshade_report.studies.common.rows import Point, Row, by
from deepshade_report.studies.common.sets import DIVERSITY, counts
from deepshade_trainer.dataset import Dataset

TITLE = "The same number of views, of more families of scenes"
FIGURE = "12"


def points(bench: Bench) -> list[Point]:
    """Every number of families with every seed."""
    several = [*DIVERSITY, len(_families())]
    return [{"families": n, "seed": seed} for n in several for seed in bench.scale.seeds]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """One training's curve, and which families it saw."""
    table = counts(bench.scale.learn_views, _families(), point["families"])
    name = f"f{point['families']}-s{point['seed']}"
    found = trained(
        bench,
        recipe(bench, seed=point["seed"]),
        name,
        sets=("diverse", "held"),
        keep=partial(taken, table=table),
    )
    return {"names": list(table), **found}


def taken(data: Dataset, numbers: Sequence[int], table: dict[str, int]) -> list[int]:
    """Of these samples the first of each family, as many as the table says."""
    left, found = dict(table), []
    for number in numbers:
        family = str(data.entries[number].record["scene"]).rpartition(":")[0]
        if left.get(family, 0) > 0:
            left[family] -= 1
            found.append(number)
    return found


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Curves of the first seed, and the last errors over the number of families."""
    with plot(2, TITLE, size=(9, 4)) as made:
        own = [row for row in rows if row["point"]["seed"] == bench.scale.seeds[0]]
        curves(made.axes[0], own, lambda row: f"{row['point']['families']} families")
        for split, style in (("train", "o:"), ("validation", "o--"), ("test", "o-")):
            means = by(rows, "families", lambda row: row[split]["dssim"])  # noqa: B023
            places = [int(name) for name in means]
            made.axes[1].plot(places, list(means.values()), style, color="#0072b2", label=split)
        made.axes[1].set_xscale("log")
        plain(made.axes[1].xaxis)
        made.axes[1].set_xlabel("families")
        made.axes[1].set_ylabel("DSSIM after the last step")
        made.axes[1].set_ylim(bottom=0)
        made.axes[1].legend()
    return made.image


def _families() -> tuple[str, ...]:
    from deepshade_workers.dataspec import expand_scenes

    return expand_scenes(["procedural"])
