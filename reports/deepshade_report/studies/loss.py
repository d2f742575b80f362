"""The paper's network trained for L1, L2, DSSIM and their sums (the paper's figure 11)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import bars, plot
from deepshade_report.studies.common.learning import recipe, trained
from deepshade_report.studies.common.rows import Point, Row, by

TITLE = "What is trained for, and what comes of it on test views"
FIGURE = "11"

LOSSES = ("l1", "l2", "dssim", "dssim + l1", "dssim + 0.5 l1", "dssim + l2")


def points(bench: Bench) -> list[Point]:
    """Every loss with every seed."""
    return [{"loss": loss, "seed": seed} for loss in LOSSES for seed in bench.scale.seeds]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """One training's curve."""
    name = f"{point['loss'].replace(' ', '')}-s{point['seed']}"
    return trained(bench, recipe(bench, loss=point["loss"], seed=point["seed"]), name)


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """DSSIM, mean absolute and root mean square error, means over seeds."""
    titles = {"dssim": "DSSIM", "mae": "mean absolute error", "rmse": "root mean square error"}
    with plot(3, TITLE, size=(11, 3)) as made:
        for axes, (figure, label) in zip(made.axes, titles.items(), strict=True):
            bars(axes, by(rows, "loss", lambda row: row["test"][figure]), label)  # noqa: B023
    return made.image
