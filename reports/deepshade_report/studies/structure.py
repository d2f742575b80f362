"""The paper's network with other widths and kernels (its figures 10 a and b)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import curves, plot
from deepshade_report.studies.common.learning import recipe, trained
from deepshade_report.studies.common.rows import Point, Row

TITLE = "The paper's network for ambient occlusion: width u0 and kernel"
FIGURE = "10 a, b"

SHAPES = ((4, 3), (8, 3), (16, 3), (4, 5), (8, 5))


def points(bench: Bench) -> list[Point]:
    """Every shape with every seed."""
    return [{"u0": u, "kernel": k, "seed": s} for u, k in SHAPES for s in bench.scale.seeds]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """One training's curve."""
    shape = {"u0": point["u0"], "kernel": point["kernel"]}
    name = "u{u0}-k{kernel}-s{seed}".format(**point)
    return trained(bench, recipe(bench, network=shape, seed=point["seed"]), name)


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Curves over steps by width, and by kernel; of the first seed."""
    own = [row for row in rows if row["point"]["seed"] == bench.scale.seeds[0]]
    with plot(2, TITLE, size=(9, 4)) as made:
        widths = [row for row in own if row["point"]["kernel"] == 3]
        curves(made.axes[0], widths, lambda row: f"u0 {row['point']['u0']}")
        kernels = [row for row in own if row["point"]["u0"] < 16]
        curves(made.axes[1], kernels, lambda row: "u0 {u0}, kernel {kernel}".format(**row["point"]))
    return made.image
