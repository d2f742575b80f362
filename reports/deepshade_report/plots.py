"""The report's plot of speed against error, and what all its pictures share, such as colours."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
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
    standing_for,
    title,
)
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
_INK, _SOFT = PALETTE["ink"], PALETTE["soft"]
_DPI = 100
_OWN = {"fast": "vermillion", "balanced": "green", "best": "blue", PAPER: "ink"}
_SPARE = ("sky", "purple", "orange", "soft")
_MARKERS = {"fp32": "o", "bf16": "s", "int8": "^"}


def speed_error(sections: Sections, effect: str) -> bytes | None:
    """PNG: DSSIM against milliseconds per megapixel, with the frontier. None without figures."""
    from matplotlib.figure import Figure

    found = points(sections)
    if not found:
        return None
    with themed():
        drawn = Figure(figsize=(9, 5.6), layout="constrained")
        _draw(drawn.subplots(), found, data(sections, "error").get("trivial_dssim"), effect)
        return png(drawn)


def _draw(axes: Axes, found: list[Point], trivial: float | None, effect: str) -> None:
    axes.loglog()
    tints = colours([point.name for point in found])
    for name, tint in tints.items():
        _method(axes, [point for point in found if point.name == name], tint)
    best = frontier(found)
    line = [p.cost for p in best], [p.error for p in best]
    axes.plot(*line, "--", color=_SOFT, linewidth=1.1, zorder=1.5, label="frontier")
    if published := getattr(folder(effect), "PUBLISHED", None):
        place = published[0] / MEGAPIXELS, (1 - published[1]) / 2
        axes.plot(*place, "*", markersize=12, markerfacecolor="none", color=_SOFT)
        note = "the paper's own figure: GTX 980 Ti,\nits own test set, not comparable in error"
        _note(axes, note, place, (9, -2), color=_SOFT, fontsize=7.5, va="center")
    if trivial:
        axes.axhline(trivial, color=_SOFT, linewidth=0.8, linestyle=":", label="trivial answer")
    for name, point in standing_for(found).items():
        shift, side = ((0, -17), "center") if point.family == NETWORK else ((6, 7), "left")
        place = point.cost, point.error
        _note(axes, title(name), place, shift, ha=side, color=tints[name], fontweight="bold")
    axes.set_xlabel("milliseconds per megapixel (less is better)")
    axes.set_ylabel("DSSIM on held-out views (less is better)")
    plain(axes.xaxis)
    plain(axes.yaxis, subs=(1, 2, 3, 4, 5, 6, 8))
    axes.margins(x=0.08, y=0.12)
    there, back = (lambda cost: cost * MEGAPIXELS), (lambda ms: ms / MEGAPIXELS)
    above = axes.secondary_xaxis("top", functions=(there, back))
    above.set_xlabel("milliseconds at 768 x 512", fontsize=8)
    plain(above.xaxis)
    for precision, marker in _MARKERS.items():
        if any(point.settings.get("precision") == precision for point in found):
            axes.plot([], [], marker, color=_INK, label=precision)
    axes.plot([], [], "o", color=_INK, markerfacecolor="none", label="ONNX Runtime")
    axes.legend(loc="lower left", ncols=2, handletextpad=0.5)


def _method(axes: Axes, own: Sequence[Point], tint: str) -> None:
    """Networks by precision, hollow on ONNX Runtime; others as dots with their own frontier."""
    if own[0].family not in (NETWORK, PAPER_NETWORK):
        best = frontier(own)
        axes.plot([p.cost for p in own], [p.error for p in own], ".", color=tint, markersize=6)
        axes.plot([p.cost for p in best], [p.error for p in best], color=tint, linewidth=1)
        return
    for point in own:
        hollow = point.settings["engine"] == "onnxruntime"
        axes.plot(
            [point.cost],
            [point.error],
            _MARKERS.get(point.settings["precision"], "P"),
            markersize=7,
            color=tint,
            markerfacecolor="white" if hollow else tint,
            markeredgewidth=1.4,
            zorder=3,
        )


def _note(axes: Axes, text: str, place: tuple[float, float], shift: Any, **style: Any) -> None:
    axes.annotate(text, place, xytext=shift, textcoords="offset points", **style)


def colours(names: Sequence[str]) -> dict[str, str]:
    """A colour for each name: its own where it has one, else the next that is free."""
    chosen: dict[str, str] = {}
    for name in dict.fromkeys(names):
        chosen[name] = PALETTE[_OWN.get(name) or _SPARE[len(chosen) % len(_SPARE)]]
    return chosen


@contextmanager
def themed() -> Iterator[None]:
    """Matplotlib's settings for a plot, restored afterwards."""
    from matplotlib import rc_context

    settings: Any = {"font.size": 9, "text.color": _INK, "figure.dpi": _DPI, "lines.linewidth": 1.6}
    settings |= {"axes.edgecolor": _SOFT, "axes.labelcolor": _INK, "axes.titlesize": 10}
    settings |= {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True}
    settings |= {"axes.axisbelow": True, "axes.titlelocation": "left", "grid.linewidth": 0.6}
    settings |= {"grid.color": PALETTE["line"], "legend.frameon": False, "legend.fontsize": 8}
    for axis in "xy":
        settings |= {f"{axis}tick.color": _SOFT, f"{axis}tick.labelcolor": _INK}
    with rc_context(settings):
        yield


def plain(axis: Any, *, subs: tuple[int, ...] = (1, 2, 5)) -> None:
    """Ordinary numbers at a log axis, at these multiples of the powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(10, subs=subs))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def png(drawn: Figure) -> bytes:
    """The figure at twice the page's resolution, on white."""
    with io.BytesIO() as stream:
        drawn.savefig(stream, format="png", dpi=2 * _DPI)
        return stream.getvalue()
