"""How errors depend on the field of view (the paper's figure 9); bundles are trained at 50 degrees.

The same eyes see the same way through wider and narrower lenses, on pictures of one size. A wider
lens shows the effect radius smaller. So each angle is measured twice: with the radius as it was in
the scene, and with the one that covers as many pixels as it did at 50 degrees. Rivals and the
trivial answer beside tell what is harder for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from deepshade_report.studies.common.bench import Bench
from deepshade_report.studies.common.drawing import COLOURS, plot
from deepshade_report.studies.common.rerender import rerendered
from deepshade_report.studies.common.rows import Point, Row
from deepshade_report.studies.common.shading import means

TITLE = "Error against the field of view"
FIGURE = "9"

ANGLES = (20, 35, 50, 65, 80, 95, 110)
LEARNT = 50
HELD = {"scene": "radius fixed in the scene", "pixels": "radius fixed in pixels"}


def points(bench: Bench) -> list[Point]:
    """Every angle, with the radius held in both ways."""
    return [
        {"fov": angle, "radius": held}
        for angle in ANGLES
        for held in HELD
        if angle != LEARNT or held == "scene"
    ]


def measure(bench: Bench, point: Point) -> dict[str, Any]:
    """Mean errors of bundles and rivals."""
    again, size = [], bench.scale.wide_side
    for view in bench.views:
        camera = replace(view.camera, width=size, height=size, x0=0, y0=0)
        lens = replace(camera, fov=float(point["fov"]))
        at_learnt = replace(camera, fov=float(LEARNT))
        radius = view.radius
        if point["radius"] == "pixels":
            radius *= at_learnt.pixels_per_unit / lens.pixels_per_unit
        again.append(rerendered(view, size, fov=lens.fov, radius=radius, spp=bench.scale.wide_spp))
    return means(bench.methods, again)


def draw(bench: Bench, rows: Sequence[Row]) -> bytes:
    """DSSIM, and its share of doing nothing's, for both ways to hold the radius."""
    with plot(3, TITLE, size=(10.5, 3.6)) as made:
        for axes, held in zip(made.axes, HELD, strict=False):
            own = [r for r in rows if r["point"]["radius"] == held or r["point"]["fov"] == LEARNT]
            angles = [row["point"]["fov"] for row in own]
            for name, colour in zip(rows[0]["dssim"], ("#6b737c", *COLOURS), strict=False):
                values = [row["dssim"][name] for row in own]
                axes.plot(angles, values, "o-", color=colour, ms=3, label=name)
                share = [v / row["dssim"]["nothing"] for v, row in zip(values, own, strict=True)]
                if name != "nothing":
                    line = "-" if held == "scene" else ":"
                    made.axes[2].plot(angles, share, line, color=colour)
            axes.plot(angles, [row["noise"] for row in own], "--", color="#6b737c", label="noise")
            axes.set_title(HELD[held])
            axes.set_ylabel("DSSIM")
        made.axes[2].set_title("share of nothing's (dotted: in pixels)")
        made.axes[0].legend()
        for axes in made.axes:
            axes.set_ylim(bottom=0)
            axes.set_xlabel("field of view, degrees")
            axes.axvline(LEARNT, color="#6b737c", linewidth=0.8, linestyle=":")
    return made.image
