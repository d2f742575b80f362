"""The report's plots of the whole service. Each takes the sections and gives a figure, or None."""

from __future__ import annotations

from typing import TYPE_CHECKING

from deepshade_report.sections import Sections, rows
from deepshade_report.server import STAGES
from deepshade_report.style import colour, colours, figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STAGE_COLOURS = {
    "decode": "sky",
    "plan": "purple",
    "infer": "blue",
    "encode": "orange",
    "transport": "soft",
}


def latency(sections: Sections) -> Figure | None:
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
            axes.barh(place, width, 0.55, left=left, color=_tint(stage), label=label)
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


def clients(sections: Sections) -> Figure | None:
    """Throughput and response times against the number of clients."""
    found = rows(sections, "clients")
    if not found:
        return None
    drawn, (left, right) = figure(9, 3.4, columns=2)
    tints = colours([row["bundle"] for row in found])
    for name, tint in tints.items():
        own = [row for row in found if row["bundle"] == name]
        count = [row["clients"] for row in own]
        middle = [row["per_second"]["median"] for row in own]
        low = [m - row["per_second"]["quartiles"][0] for m, row in zip(middle, own, strict=True)]
        high = [row["per_second"]["quartiles"][1] - m for m, row in zip(middle, own, strict=True)]
        left.errorbar(count, middle, yerr=[low, high], color=tint, marker="o", label=name)
        right.plot(count, [r["median_ms"] for r in own], color=tint, marker="o", label=name)
        right.plot(count, [r["p95_ms"] for r in own], color=tint, marker="s", linestyle="--")
        right.plot(count, [r["most_ms"] for r in own], color=tint, marker="^", linestyle=":")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(count, [str(number) for number in count])
        axes.set_ylim(bottom=0)
        axes.set_xlabel("clients that ask without a pause")
    left.set_title("requests a second")
    right.set_title("milliseconds: median (line), 95 % (dashed), slowest (dots)")
    left.legend()
    return drawn


def sizes(sections: Sections) -> Figure | None:
    """Cost per megapixel and peak memory against the picture's size."""
    found = rows(sections, "sizes")
    if not found:
        return None
    drawn, (left, right) = figure(9, 3.4, columns=2)
    settings = sorted({row["memory_setting"] for row in found}, reverse=True)
    for memory, tint in zip(settings, ("blue", "vermillion"), strict=False):
        own = [row for row in found if row["memory_setting"] == memory]
        label = f"--memory {memory / 2**30:.3g}G"
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


def background(sections: Sections) -> Figure | None:
    """The service's time against the share of background."""
    found = rows(sections, "background")
    if not found:
        return None
    drawn, (axes,) = figure(9, 3.6)
    tints = colours([row["bundle"] for row in found])
    for (name, shape), line in (
        ((name, shape), "-" if shape == "sky" else "--")
        for name in tints
        for shape in ("sky", "object")
    ):
        own = [row for row in found if row["bundle"] == name and row["shape"] == shape]
        middle = [row["of_full"]["median"] for row in own]
        share = [100 * row["share"] for row in own]
        where = "from the top down" if shape == "sky" else "all around an object"
        axes.plot(share, middle, line, marker="o", color=tints[name], label=f"{name}, {where}")
        axes.fill_between(
            share,
            [row["of_full"]["quartiles"][0] for row in own],
            [row["of_full"]["quartiles"][1] for row in own],
            color=tints[name],
            alpha=0.15,
            linewidth=0,
        )
    axes.plot([0, 100], [1, 0], color=colour("soft"), linewidth=0.8, linestyle=":")
    axes.plot([50], [0.6], "_", color=colour("ink"), markersize=16, markeredgewidth=2)
    axes.text(53.5, 0.6, "target", va="center", fontsize=8)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("background, % of the picture")
    axes.set_ylabel("time / time of a full frame")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return drawn


def savings(sections: Sections) -> Figure | None:
    """What the planner left out of the network's work, view by view, and the time it took."""
    found = rows(sections, "savings")
    if not found:
        return None
    drawn, (left, right) = figure(9, 3.4, columns=2)
    tints = colours([row["bundle"] for row in found])
    for name, tint in tints.items():
        own = [row for row in found if row["bundle"] == name]
        share = [100 * (1 - row["computed_share"]) for row in own]
        left.plot(share, [row["of_full_ms"] for row in own], "o", color=tint, alpha=0.7, label=name)
        order = sorted(share, reverse=True)
        right.plot(range(1, len(order) + 1), order, color=tint, label=name)
    left.set_title("infer time / the whole picture's")
    left.set_xlabel("pixels not computed, %")
    left.set_ylim(bottom=0)
    right.set_title("pixels not computed, %, by view")
    right.set_xlabel("held-out views, most first")
    right.set_ylim(0, 100)
    left.legend()
    return drawn


def _tint(stage: str) -> str:
    return colour(_STAGE_COLOURS[stage])
