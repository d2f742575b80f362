"""Networks beside HBAO and GTAO in the same time (the paper's figure 6), on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from statistics import fmean
from typing import Any

from deepshade.engines import choose, load_engine
from deepshade.pictures import shading
from deepshade.timing import Pace, alternate, significant, spread
from deepshade_report.baselines import baselines
from deepshade_report.method import Method, Network, identity
from deepshade_report.plots import plain
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import COLOURS, plot
from deepshade_report.studies.common.rows import Point, Row
from deepshade_report.studies.common.shading import answers
from deepshade_report.view import HEIGHT, WIDTH, fullest, resized

TITLE = "The same time: error against milliseconds at 768 x 512"
FIGURE = "6"

RIVALS = ("HBAO", "GTAO")
_CROP = 224  # pixels


def points(bench: Bench) -> list[Point]:
    """The error of each method, and all times at once: they are taken in turns."""
    return [*({"error": name} for name in _methods(bench)), {"speed": "all"}]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """Mean DSSIM of one method, or the milliseconds of all."""
    found = _methods(bench)
    if "error" in point:
        own = {"it": found[point["error"]]}
        each = [view.dssim(image) for view in bench.views for _, image in answers(own, view)]
        return {"name": own["it"].name, "dssim": significant(fmean(each)), "views": len(each)}
    frame = resized(fullest(bench.views))
    for method in found.values():
        method.prepare(frame)
    tasks = {name: partial(method.shade, frame) for name, method in found.items()}
    times = alternate(
        tasks,
        Pace(bench.scale.speed_seconds, 3, 25),
        advance=lambda share, name: bench.doing(f"timing {name}"),
    )
    nothing = fmean(view.dssim(view.trivial()) for view in bench.views)
    return {
        "frame": [WIDTH, HEIGHT],
        "nothing": significant(nothing),
        "ms": {name: spread(figures["ms"]) for name, figures in times.items()},
    }


def within(rows: Sequence[Row], budget: float, name: str) -> Row | None:
    """The row of the method's setting with the least error that takes at most `budget` ms.

    Its "ms" is added. None where none fits.
    """
    times = next(row["ms"] for row in rows if "speed" in row["point"])
    own = [
        {**row, "ms": ms}
        for row in rows
        if row.get("name") == name and (ms := times[row["point"]["error"]]["median"]) <= budget
    ]
    return min(own, key=lambda row: float(row["dssim"]), default=None)


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Error over time, and a crop of the first view in `balanced`'s time."""
    names = list(dict.fromkeys(row["name"] for row in rows if "name" in row))
    times = next(row for row in rows if "speed" in row["point"])
    ours = [name for name in names if name not in RIVALS]
    middle = "balanced" if "balanced" in ours else ours[0]
    budget = next(
        times["ms"][row["point"]["error"]]["median"] for row in rows if row.get("name") == middle
    )
    with plot(4, TITLE, size=(12, 3.6)) as made:
        axes = made.axes[0]
        axes.set_xscale("log")
        for name, colour in zip(names, COLOURS, strict=False):
            own = [row for row in rows if row.get("name") == name]
            ms = [times["ms"][row["point"]["error"]]["median"] for row in own]
            axes.plot(ms, [row["dssim"] for row in own], "o-", color=colour, ms=4, label=name)
        axes.axvline(budget, color="#6b737c", linewidth=0.8, linestyle=":")
        axes.set_xlabel(f"milliseconds at {WIDTH} x {HEIGHT}")
        axes.set_ylabel("DSSIM")
        axes.set_ylim(bottom=0)
        plain(axes.xaxis)
        axes.legend()
        view, found = bench.views[0], _methods(bench)
        top, left = max(0, (view.height - _CROP) // 2), max(0, (view.width - _CROP) // 2)
        crop = slice(top, top + _CROP), slice(left, left + _CROP)
        shown = {"reference": view.reference}
        for name in (middle, RIVALS[0]):
            if best := within(rows, budget, name):
                label = f"{name}, {best['ms']:.0f} ms"
                shown[label] = next(answers({name: found[best["point"]["error"]]}, view))[1]
        for place, (label, image) in zip(made.axes[1:], shown.items(), strict=False):
            place.imshow(shading(image[0][crop]))
            place.set_title(label if label == "reference" else f"{label}: {view.dssim(image):.3f}")
        for place in made.axes[1:]:
            place.axis("off")
    return made.image


def _methods(bench: Bench) -> dict[str, Method]:
    """Each bundle as it runs by default, and the rivals at all settings, by identity."""
    if "methods" not in bench.cache:
        served = [(bundle, choose(bundle)) for bundle in bench.context.served]
        found: list[Method] = [
            Network(bundle, load_engine(bundle, backend, threads=bench.threads))
            for bundle, backend in served
        ]
        others, _ = baselines("ao", False, bench.threads)
        found += [method for method in others if method.name in RIVALS]
        bench.cache["methods"] = {identity(method): method for method in found}
    return dict(bench.cache["methods"])
