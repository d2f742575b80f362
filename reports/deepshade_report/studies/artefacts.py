"""Typical artefacts (the paper's figure 7), found and sorted by what is around them.

An error is what of |answer - reference| the reference's noise doesn't explain. Each pixel's error
belongs to the first kind that fits. Depth steps and radii come from the G-buffer; local contrast
is the standard deviation in 9 x 9 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.pictures import difference, shading
from deepshade.timing import significant
from deepshade_report.plots import png, themed
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import COLOURS, smaller
from deepshade_report.studies.common.rows import Point, Row
from deepshade_report.studies.common.shading import answers
from deepshade_report.view import Float, View

TITLE = "Typical artefacts: the worst of each kind, and the share of all error that each has"
FIGURE = "7"

KINDS = {
    "halo": "too dark beside a nearer surface that is out of reach",
    "hidden": "too bright beside a nearer surface: what occludes may be hidden",
    "border": "too bright at the picture's border: what occludes may be outside",
    "lost": "less than half of the reference's local contrast",
    "invented": "more than twice the reference's local contrast",
    "shade": "all else: smoothly too bright or too dark",
}
_NEAR = 16  # pixels from a depth step, or from the border
_WINDOW = 9
_CONTRAST = 0.03  # local contrast that counts as some
_PATCH, _CROP = 33, 112  # pixels: of which the mean is the worst, and what is shown


def points(bench: Bench) -> list[Point]:
    """Every view."""
    return [{"view": number} for number in range(len(bench.views))]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """For each method the mean error by kind, and where each kind is worst."""
    view, found = bench.views[point["view"]], {}
    for name, image in answers(bench.methods, view):
        error, kind = sorted_errors(view, image)
        found[name] = {
            each: {
                "mean": significant(float(np.where(kind == number, error, 0).mean())),
                **_worst(np.where(kind == number, error, 0)),
            }
            for number, each in enumerate(KINDS)
        }
    return {"scene": view.scene, "methods": found}


def sorted_errors(view: View, image: Float) -> tuple[NDArray[Any], NDArray[Any]]:
    """An answer's error (H, W) beyond twice the reference's noise, and its kind's number."""
    from scipy.ndimage import minimum_filter

    answer, truth = image[0].astype(np.float64), view.reference[0].astype(np.float64)
    noise = np.zeros_like(truth) if view.error is None else view.error[0]
    error = np.maximum(np.abs(answer - truth) - 2 * noise, 0)
    error[view.background] = 0
    depth = np.where(view.background, np.inf, -view.attributes["position"][2])
    nearer = minimum_filter(depth, 2 * _NEAR + 1, mode="nearest")
    with np.errstate(invalid="ignore"):
        step = np.where(view.background, 0, depth - nearer)
    pixels = view.radius / np.maximum(depth, 1e-30) * view.camera.pixels_per_unit
    rows, columns = np.indices(depth.shape)
    edge = np.minimum(rows, columns)
    edge = np.minimum(edge, np.minimum(view.height - 1 - rows, view.width - 1 - columns))
    bright, ours, theirs = answer > truth, _contrast(answer), _contrast(truth)
    tests = (
        ~bright & (step > view.radius),
        bright & (step > 0.25 * view.radius),
        bright & (edge < np.minimum(_NEAR, pixels)),
        (theirs > _CONTRAST) & (ours < theirs / 2),
        (ours > _CONTRAST) & (theirs < ours / 2),
    )
    return error, np.select(tests, range(len(tests)), len(tests))


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """Crops of one bundle's worst places, and bars of all methods' shares."""
    from matplotlib.figure import Figure

    methods = list(rows[0]["methods"])
    name = "balanced" if "balanced" in methods else methods[0]
    with themed():
        figure = Figure(figsize=(9.6, 1.55 * len(KINDS)), layout="constrained")
        figure.suptitle(TITLE, x=0.01, ha="left", fontsize=10, fontweight="bold")
        halves: Any = figure.subfigures(1, 2)
        left, right = halves
        grid = left.subplots(len(KINDS), 3)
        for line, (kind, row) in zip(grid, _examples(rows, name).items(), strict=True):
            view = bench.views[row["point"]["view"]]
            _, image = next(answers({name: bench.methods[name]}, view))
            crop = _cropped(view, row["methods"][name][kind]["at"])
            ours, theirs = image[0][crop], view.reference[0][crop]
            pictures = shading(theirs), shading(ours), difference(ours, theirs)
            for axes, picture in zip(line, pictures, strict=True):
                axes.imshow(picture)
                axes.set_xticks([])
                axes.set_yticks([])
            line[0].set_ylabel(kind, fontweight="bold")
        for axes, title in zip(grid[0], ("reference", name, "difference"), strict=True):
            axes.set_title(title)
        axes = right.subplots()
        _bars(axes, rows, methods)
        return smaller(png(figure))


def _examples(rows: Sequence[Row], name: str) -> dict[str, Row]:
    """For each kind the view where a method's is worst, as far as possible each from another."""
    found: dict[str, Row] = {}
    for kind in KINDS:
        free = [row for row in rows if row not in found.values()] or list(rows)
        found[kind] = max(free, key=lambda row: float(row["methods"][name][kind]["worst"]))
    return found


def _bars(axes: Any, rows: Sequence[Row], methods: Sequence[str]) -> None:
    low = np.zeros(len(methods))
    for kind, colour in zip(KINDS, COLOURS, strict=False):
        means = [np.mean([row["methods"][name][kind]["mean"] for row in rows]) for name in methods]
        axes.bar(methods, means, bottom=low, color=colour, label=kind)
        low += np.array(means)
    axes.set_ylabel("mean absolute error beyond noise")
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper left", ncols=2)
    axes.set_ylim(0, 1.25 * low.max())
    axes.grid(axis="x", visible=False)


def _contrast(plane: NDArray[Any]) -> NDArray[Any]:
    from scipy.ndimage import uniform_filter

    centred = plane - plane.mean()
    mean, square = uniform_filter(centred, _WINDOW), uniform_filter(centred**2, _WINDOW)
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0)))


def _worst(error: NDArray[Any]) -> dict[str, Any]:
    """The largest mean of a patch, and the row and column of its centre."""
    from scipy.ndimage import uniform_filter

    means = uniform_filter(error, _PATCH, mode="constant")
    row, column = np.unravel_index(int(means.argmax()), means.shape)
    return {"worst": significant(float(means.max())), "at": [int(row), int(column)]}


def _cropped(view: View, at: Sequence[int]) -> tuple[slice, slice]:
    """Rows and columns of a crop about a place, within the picture."""
    spans = []
    for middle, length in zip(at, (view.height, view.width), strict=True):
        low = min(max(0, middle - _CROP // 2), max(0, length - _CROP))
        spans.append(slice(low, low + _CROP))
    return spans[0], spans[1]
