"""The report's plots, for files and for the page, in one palette for the colour-blind.

Each takes the sections and the effect's name, and gives a figure, or None without its data.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from deepshade_report.baselines import folder
from deepshade_report.method import NETWORK, PAPER, PAPER_NETWORK
from deepshade_report.sections import (
    Point,
    Sections,
    data,
    frontier,
    points,
    rows,
    standing_for,
    title,
)
from deepshade_report.server import STAGES
from deepshade_report.view import MEGAPIXELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito, "Color Universal Design", 2008.
PALETTE = {
    "vermillion": "#d55e00",
    "green": "#009e73",
    "blue": "#0072b2",
    "purple": "#cc79a7",
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "ink": "#1c2126",
    "soft": "#6b737c",
    "line": "#d9dde1",
}
DPI = 100
_OWN = {"fast": "vermillion", "balanced": "green", "best": "blue", PAPER: "ink"}
_SPARE = ("sky", "purple", "orange", "soft")
_MARKERS = {"fp32": "o", "bf16": "s", "int8": "^"}
_STAGES = {
    "decode": "sky",
    "plan": "purple",
    "infer": "blue",
    "encode": "orange",
    "transport": "soft",
}


def speed_error(sections: Sections, effect: str) -> Figure | None:
    """DSSIM against milliseconds per megapixel, both logarithmic, with the frontier."""
    found = points(sections)
    if not found:
        return None
    drawn, (axes,) = figure(9, 5.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    tints = colours([point.name for point in found])
    soft = colour("soft")
    for name, tint in tints.items():
        _method(axes, [point for point in found if point.name == name], tint)
    best = frontier(found)
    dashes: Any = (0, (4, 3))
    line = [p.cost for p in best], [p.error for p in best]
    axes.plot(*line, color=soft, linewidth=1.1, linestyle=dashes, zorder=1.5, label="frontier")
    if published := getattr(folder(effect), "PUBLISHED", None):
        place = published[0] / MEGAPIXELS, (1 - published[1]) / 2
        axes.plot(*place, "*", markersize=12, markerfacecolor="none", color=soft)
        note = "the paper's own figure: GTX 980 Ti,\nits own test set, not comparable in error"
        _note(axes, note, place, (9, -2), color=soft, fontsize=7.5, va="center")
    if trivial := (data(sections, "error") or {}).get("trivial_dssim"):
        axes.axhline(trivial, color=soft, linewidth=0.8, linestyle=":", label="trivial answer")
    for name, point in standing_for(found).items():
        ours, place = point.family == NETWORK, (point.cost, point.error)
        shift, side = ((0, -17), "center") if ours else ((6, 7), "left")
        _note(axes, title(name), place, shift, ha=side, color=tints[name], fontweight="bold")
    axes.set_xlabel("milliseconds per megapixel (less is better)")
    axes.set_ylabel("DSSIM on held-out views (less is better)")
    plain(axes.xaxis)
    plain(axes.yaxis, subs=(1, 2, 3, 4, 5, 6, 8))
    axes.margins(x=0.08, y=0.12)
    functions = (lambda value: value * MEGAPIXELS, lambda value: value / MEGAPIXELS)
    above = axes.secondary_xaxis("top", functions=functions)
    above.set_xlabel("milliseconds at 768 x 512", fontsize=8)
    plain(above.xaxis)
    for precision, marker in _MARKERS.items():
        if any(point.settings.get("precision") == precision for point in found):
            axes.plot([], [], marker, color=colour("ink"), label=precision)
    axes.plot([], [], "o", color=colour("ink"), markerfacecolor="none", label="ONNX Runtime")
    axes.legend(loc="lower left", ncols=2, handletextpad=0.5)
    return drawn


def _method(axes: Axes, own: Sequence[Point], tint: str) -> None:
    """Networks by precision, hollow on ONNX Runtime; others as dots with their own frontier."""
    network = own[0].family in (NETWORK, PAPER_NETWORK)
    for point in own:
        hollow = network and point.settings.get("engine") == "onnxruntime"
        axes.plot(
            [point.cost],
            [point.error],
            _MARKERS.get(str(point.settings.get("precision")), "P") if network else ".",
            markersize=7 if network else 6,
            color=tint,
            markerfacecolor="white" if hollow else tint,
            markeredgewidth=1.4,
            zorder=3 if network else 2,
        )
    if not network:
        best = frontier(own)
        axes.plot([p.cost for p in best], [p.error for p in best], color=tint, linewidth=1)


def _note(axes: Axes, text: str, place: tuple[float, float], shift: Any, **style: Any) -> None:
    axes.annotate(text, place, xytext=shift, textcoords="offset points", **style)


def latency(sections: Sections, effect: str) -> Figure | None:
    """Where a request's time goes, beside the bare network."""
    found = rows(sections, "service")
    if not found:
        return None
    drawn, (axes,) = figure(9, 1.1 + 0.62 * len(found))
    for place, row in enumerate(found):
        left = 0.0
        for stage in (*STAGES, "transport"):
            width = row["stages_ms"][stage]["median"]
            label = stage if place == 0 else None
            axes.barh(place, width, 0.55, left=left, color=colour(_STAGES[stage]), label=label)
            if width > 0.06 * row["total_ms"]["median"] and stage != "plan":
                # black in both themes: the bars are light enough
                where = left + width / 2, place
                axes.text(*where, f"{width:.1f}", color="k", ha="center", va="center", fontsize=7.5)
            left += width
        axes.plot(
            [row["bare_ms"]["median"]] * 2,
            [place - 0.4, place + 0.4],
            color=colour("ink"),
            linewidth=2,
            label="bare network" if place == 0 else None,
        )
        note = f"{row['total_ms']['median']:.1f} ms = {row['ratio']['median']:.2f} x bare"
        axes.annotate(
            note, (left, place), xytext=(6, 0), textcoords="offset points", va="center", fontsize=8
        )
    axes.set_yticks(range(len(found)), [f"{row['bundle']}\n{row['backend']}" for row in found])
    axes.invert_yaxis()
    axes.margins(x=0.25)
    axes.grid(False, axis="y")
    axes.set_xlabel("milliseconds, 768 x 512, half ZIP in and out (transport: HTTP, on top)")
    drawn.legend(loc="outside upper left", ncols=6)
    return drawn


def sizes(sections: Sections, effect: str) -> Figure | None:
    """Cost per megapixel and peak memory against the picture's size."""
    found = rows(sections, "sizes")
    if not found:
        return None
    drawn, (left, right) = figure(9, 3.4, columns=2)
    settings = dict.fromkeys(row["memory"] for row in found)
    for memory, tint in zip(settings, ("blue", "vermillion"), strict=False):
        own = [row for row in found if row["memory"] == memory]
        label = f"--memory {memory}" if memory else "as it is served by default"
        x = [row["megapixels"] for row in own]
        left.plot(
            x, [row["ms_per_megapixel"] for row in own], "o-", color=colour(tint), label=label
        )
        known = [row for row in own if row["peak_above_idle"]]
        right.plot(
            [row["megapixels"] for row in known],
            [row["peak_above_idle"] / 2**20 for row in known],
            "o-",
            color=colour(tint),
            label=label,
        )
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("megapixels")
        plain(axes.xaxis, subs=(1,))
        plain(axes.yaxis)
        axes.legend()
    left.set_title("service, milliseconds per megapixel")
    right.set_title("peak memory above the idle service, MiB")
    return drawn


PLOTS: dict[str, Callable[[Sections, str], Figure | None]] = {
    "speed-error": speed_error,
    "latency": latency,
    "sizes": sizes,
}


def colour(name: str) -> str:
    """A palette colour as plots draw it."""
    return PALETTE[name]


def colours(names: list[str]) -> dict[str, str]:
    """A colour for each name: its own where it has one, else the next that is free."""
    spare = [colour(name) for name in _SPARE]
    chosen: dict[str, str] = {}
    for name in dict.fromkeys(names):
        own = _OWN.get(name)
        chosen[name] = colour(own) if own else spare[len(chosen) % len(spare)]
    return chosen


@contextmanager
def themed() -> Iterator[None]:
    """Matplotlib's settings for a plot, restored afterwards."""
    from matplotlib import rc_context

    ink, soft = colour("ink"), colour("soft")
    settings: Any = {"font.size": 9, "text.color": ink, "figure.dpi": DPI, "lines.linewidth": 1.6}
    settings |= {"axes.edgecolor": soft, "axes.labelcolor": ink, "axes.titlesize": 10}
    settings |= {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True}
    settings |= {"axes.axisbelow": True, "axes.titlelocation": "left", "grid.linewidth": 0.6}
    settings |= {"grid.color": colour("line"), "legend.frameon": False, "legend.fontsize": 8}
    settings |= {f"{axis}tick.color": soft for axis in "xy"}
    settings |= {f"{axis}tick.labelcolor": ink for axis in "xy"}
    with rc_context(settings):
        yield


def figure(width: float, height: float, columns: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure of so many inches with a row of axes; call it inside `themed`."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained")
    axes = drawn.subplots(1, columns, squeeze=False)
    return drawn, list(axes[0])


def plain(axis: Any, *, subs: tuple[int, ...] = (1, 2, 5)) -> None:
    """Ordinary numbers at a log axis, at these multiples of the powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    form = FuncFormatter(lambda value, _: f"{value:g}")
    axis.set_major_locator(LogLocator(10, subs=subs))
    axis.set_major_formatter(form)
    axis.set_minor_formatter(NullFormatter())


def png(drawn: Figure) -> bytes:
    """The figure at twice the page's resolution, on white."""
    with io.BytesIO() as stream:
        drawn.savefig(stream, format="png", dpi=2 * DPI)
        return stream.getvalue()
