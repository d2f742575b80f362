"""How errors depend on the effect radius in pixels, at several resolutions (the paper's figure 8).

The same views are rendered again at each size with each radius, a share of their median depth.
Networks are trained at 512 pixels and 50 degrees with shares of 0.05 to 0.5. On the smaller sizes
`balanced` also shades pixels repeated twice each way: does it lack pixels, or detail?
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from deepshade_report.method import Network
from deepshade_report.plots import plain
from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.doubled import Doubled
from deepshade_report.studies.common.drawing import COLOURS, plot
from deepshade_report.studies.common.rerender import median_depth, rerendered
from deepshade_report.studies.common.rows import Point, Row
from deepshade_report.studies.common.shading import means

TITLE = "Error against the effect radius in pixels"
FIGURE = "8"

SHARES = (0.05, 0.1, 0.2, 0.4, 0.8)
DOUBLED = "balanced"
LEARNT = 27, 275  # pixels: what the radius is at the median depth of a view that was trained on


def points(bench: Bench) -> list[Point]:
    """Every size with every radius."""
    sides = [bench.scale.wide_side // part for part in (4, 2, 1)]
    return [{"size": size, "share": share} for size in sides for share in SHARES]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """Mean errors of bundles and rivals, and the radius in pixels."""
    again, pixels = [], []
    for view in bench.views:
        radius = point["share"] * median_depth(view)
        fov = view.camera.fov
        found = rerendered(view, point["size"], fov=fov, radius=radius, spp=bench.scale.wide_spp)
        again.append(found)
        pixels.append(point["share"] * found.camera.pixels_per_unit)
    methods = dict(bench.methods)
    if DOUBLED in methods and point["size"] < bench.scale.wide_side:
        network = methods[DOUBLED]
        assert isinstance(network, Network)
        methods[f"{DOUBLED}, doubled"] = Doubled(network)
    return {"pixels": fmean(pixels), **means(methods, again)}


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """A panel for each method, a line for each size."""
    names = [name for name in rows[0]["dssim"] if name != "nothing"]
    with plot(len(names), TITLE, size=(2.3 * len(names), 3.3)) as made:
        for axes, name in zip(made.axes, names, strict=True):
            axes.set_xscale("log")
            plain(axes.xaxis, subs=(1, 3))
            axes.axvspan(*LEARNT, color="#eef1f4", zorder=0)
            for size, colour in zip(
                sorted({r["point"]["size"] for r in rows}), COLOURS, strict=False
            ):
                own = [r for r in rows if r["point"]["size"] == size and name in r["dssim"]]
                shares = [row["dssim"][name] / row["dssim"]["nothing"] for row in own]
                axes.plot(
                    [r["pixels"] for r in own], shares, "o-", color=colour, ms=3, label=f"{size} px"
                )
            axes.set_title(name)
            axes.set_ylim(0, 1)
            axes.set_xlabel("radius, pixels")
        made.axes[0].set_ylabel("DSSIM, share of doing nothing's")
        made.axes[0].legend()
    return made.image
