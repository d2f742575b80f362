"""Learning curves of the paper's networks for all effects (its figures 10 c and d).

Views draw lights, lenses, motions and materials anew. The environment is the same in all and even
all around: the paper's networks aren't told of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from deepshade.effects import EFFECTS
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import curves, plot
from deepshade_report.studies.common.learning import recipe, trained
from deepshade_report.studies.common.rows import Point, Row

TITLE = "The paper's networks for all effects"
FIGURE = "10 c, d"


def points(bench: Bench) -> list[Point]:
    """Every effect."""
    return [{"effect": name} for name in EFFECTS]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """One training's curve."""
    made = recipe(bench, point["effect"], steps=bench.scale.effect_steps)
    return trained(bench, made, point["effect"], sets=("effects", "effects-held"))


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Errors on the training views, and on the test views."""
    with plot(2, TITLE, size=(9, 4)) as made:
        for axes, split in zip(made.axes, ("train", "test"), strict=True):
            name = (lambda row: str(row["point"]["effect"])) if split == "test" else _no_name
            curves(axes, rows, name, splits=(split,))
    return made.image


def _no_name(row: Row) -> str:
    return ""
