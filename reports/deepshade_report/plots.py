"""All of the report's plots, and those of speed against error themselves.

Each takes the sections and gives a figure, or None without its data.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from deepshade_report import derived
from deepshade_report.frames import MEGAPIXELS
from deepshade_report.sections import Sections, data
from deepshade_report.service_plots import background, clients, latency, savings, sizes
from deepshade_report.style import MARKERS, colour, colours, figure, plain
from deepshade_report.subjects import NETWORK, PAPER_NETWORK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def speed_error(sections: Sections) -> Figure | None:
    """DSSIM against milliseconds per megapixel, both logarithmic, with the frontier."""
    points = derived.points(sections)
    if not points:
        return None
    drawn, (axes,) = figure(9, 5.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    tints = colours([point.name for point in points])
    for name in tints:
        _methods(axes, [point for point in points if point.name == name], tints[name])
    best = derived.frontier_of(points)
    axes.plot(
        [point.cost for point in best],
        [point.error for point in best],
        color=colour("soft"),
        linewidth=1.1,
        linestyle=(0, (4, 3)),
        zorder=1.5,
    )
    published = derived.PUBLISHED
    axes.plot(
        [published.cost],
        [published.error],
        "*",
        markersize=12,
        markerfacecolor="none",
        color=colour("soft"),
    )
    axes.annotate(
        "the paper's own figure: GTX 980 Ti,\nits own test set, not comparable in error",
        (published.cost, published.error),
        xytext=(9, -2),
        textcoords="offset points",
        fontsize=7.5,
        color=colour("soft"),
        va="center",
    )
    trivial = (data(sections, "error") or {}).get("trivial_dssim")
    if trivial:
        axes.axhline(trivial, color=colour("soft"), linewidth=0.8, linestyle=":")
        axes.text(
            0.995,
            trivial,
            "all white ",
            transform=axes.get_yaxis_transform(),
            fontsize=7.5,
            color=colour("soft"),
            ha="right",
            va="bottom",
        )
    _labels(axes, sections, points, tints)
    axes.set_xlabel("milliseconds per megapixel (less is better)")
    axes.set_ylabel("DSSIM on held-out real views (less is better)")
    plain(axes.xaxis)
    plain(axes.yaxis, subs=(1, 2, 3, 4, 5, 6, 8))
    axes.margins(x=0.08, y=0.12)
    above = axes.secondary_xaxis("top", functions=(_at_frame, _per_megapixel))
    above.set_xlabel("milliseconds at 768 x 512", fontsize=8)
    plain(above.xaxis)
    _legend(axes, points)
    return drawn


def _methods(axes: Axes, points: list[derived.Point], tint: str) -> None:
    """Networks by precision and engine; other methods as small dots with their own frontier."""
    for point in points:
        network = point.family in (NETWORK, PAPER_NETWORK)
        hollow = network and point.settings.get("engine") == "onnxruntime"
        axes.plot(
            [point.cost],
            [point.error],
            MARKERS.get(str(point.settings.get("precision")), "P") if network else ".",
            markersize=7 if network else 6,
            color=tint,
            markerfacecolor=colour("paper") if hollow else tint,
            markeredgewidth=1.4,
            alpha=1 if network else 0.75,
            zorder=3 if network else 2,
        )
    if points[0].family not in (NETWORK, PAPER_NETWORK) and len(points) > 1:
        best = derived.frontier_of(points)
        axes.plot(
            [point.cost for point in best],
            [point.error for point in best],
            color=tint,
            linewidth=1,
            alpha=0.7,
        )


def _labels(
    axes: Axes, sections: Sections, points: list[derived.Point], tints: dict[str, str]
) -> None:
    """Each method's name at the point that stands for it."""
    for name, tint in tints.items():
        point = derived.standing_for(sections, [p for p in points if p.name == name])
        ours = point.family == NETWORK
        axes.annotate(
            "the paper's network" if point.family == PAPER_NETWORK else name,
            (point.cost, point.error),
            xytext=(0, -17) if ours else (6, 7),
            textcoords="offset points",
            ha="center" if ours else "left",
            color=tint,
            fontweight="bold",
            fontsize=9,
            zorder=4,
        )


def _legend(axes: Axes, points: list[derived.Point]) -> None:
    from matplotlib.lines import Line2D

    networks = [point for point in points if point.family in (NETWORK, PAPER_NETWORK)]
    used = [p for p in MARKERS if any(point.settings.get("precision") == p for point in networks)]
    ink = colour("ink")
    entries = [
        Line2D([], [], marker=MARKERS[p], color=ink, linestyle="", markersize=6, label=p)
        for p in used
    ]
    for label, face in (("ONNX Runtime", colour("paper")), ("OpenVINO", ink)):
        entries.append(
            Line2D([], [], marker="o", color=ink, markerfacecolor=face, linestyle="", label=label)
        )
    entries.append(Line2D([], [], color=colour("soft"), linestyle=(0, (4, 3)), label="frontier"))
    axes.legend(handles=entries, loc="lower left", ncols=2, handletextpad=0.5)


def same_time(sections: Sections) -> Figure | None:
    """The least error that each method reaches within a time, as the paper's figure 6 compares."""
    points = derived.points(sections)
    if not points:
        return None
    drawn, (axes,) = figure(9, 4)
    axes.set_xscale("log")
    tints = colours([point.name for point in points])
    longest = 1.6 * max(point.milliseconds for point in points)
    for name, tint in tints.items():
        best = derived.frontier_of([point for point in points if point.name == name])
        axes.step(
            [*(point.milliseconds for point in best), longest],
            [*(point.error for point in best), best[-1].error],
            where="post",
            color=tint,
            label="the paper's network" if best[0].family == PAPER_NETWORK else name,
        )
        axes.plot([best[0].milliseconds], [best[0].error], "o", markersize=4, color=tint)
    for name, budget in derived.budgets(sections):
        axes.axvline(budget, color=colour("soft"), linewidth=0.8, linestyle=":")
        axes.text(
            budget,
            1.0,
            name,
            transform=axes.get_xaxis_transform(),
            fontsize=7.5,
            color=colour("soft"),
            rotation=90,
            ha="right",
            va="top",
        )
    axes.set_ylim(bottom=0)
    axes.set_xlabel("milliseconds allowed for 768 x 512")
    axes.set_ylabel("least DSSIM within that time")
    plain(axes.xaxis)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return drawn


def _at_frame(value: Any) -> Any:
    return value * MEGAPIXELS


def _per_megapixel(value: Any) -> Any:
    return value / MEGAPIXELS


PLOTS: dict[str, tuple[str, Callable[[Sections], Any]]] = {
    "speed-error": ("Milliseconds per megapixel against DSSIM", speed_error),
    "same-time": ("What each method reaches in the same time", same_time),
    "latency": ("Where a request's time goes", latency),
    "clients": ("Throughput and response times by number of clients", clients),
    "sizes": ("Cost per megapixel and peak memory by size", sizes),
    "background": ("Time by share of background", background),
    "savings": ("What the planner saved on held-out views", savings),
}
