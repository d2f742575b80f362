"""One real view by each method, side by side: the section `comparison` and its picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from deepshade import pictures
from deepshade.errors import DeepshadeError
from deepshade_report.context import Context
from deepshade_report.method import identity
from deepshade_report.plots import colour, png, themed
from deepshade_report.sections import Skipped, points, standing_for, title
from deepshade_report.sections.methods import methods, shaded
from deepshade_report.timing import significant
from deepshade_report.view import View

PICTURE = "comparison.png"
_CROP = 384  # pixels of the view that are shown, so that details can be seen
_MAX_BACKGROUND = 0.15


def comparison(context: Context) -> dict[str, Any]:
    """Figures of the panels; draws `PICTURE` into the report's folder.

    Networks run on their default backends and the screen-space methods with their best settings,
    as the sections `error` and `speed` found them. Raises Skipped without those.
    """
    chosen = {point.id: point for point in standing_for(points(context.measured)).values()}
    if not chosen:
        raise Skipped("it needs the sections error and speed")
    views = [view for view in context.views if view.background.mean() <= _MAX_BACKGROUND]
    views = sorted(views or context.views, key=lambda view: view.contrast())
    view = views[len(views) // 2]
    panels: list[dict[str, Any]] = []
    for method in methods(context)[0]:
        point = chosen.get(identity(method))
        if point is None or getattr(method, "needs_scene", False):
            continue
        context.advance(len(panels) / len(chosen), point.id)
        try:
            method.prepare(view)
            image = shaded(method, view)
        except DeepshadeError:
            continue
        dssim, ms = significant(view.dssim(image)), significant(point.milliseconds)
        panels.append({"id": point.id, "name": title(method.name), "dssim": dssim, "ms": ms})
        panels[-1]["image"] = image
    context.out.mkdir(parents=True, exist_ok=True)
    (context.out / PICTURE).write_bytes(draw(view, panels))
    figures = [{k: v for k, v in panel.items() if k != "image"} for panel in panels]
    return {"scene": view.scene, "picture": PICTURE, "panels": figures}


def telling(view: View) -> tuple[slice, slice, slice]:
    """Channels, rows and columns, at most 384 of each, where the reference varies most."""
    height, width = min(view.height, _CROP), min(view.width, _CROP)
    reference = view.exposed(view.reference)
    places = [
        (slice(None), slice(top, top + height), slice(left, left + width))
        for top in range(0, view.height - height + 1, 32)
        for left in range(0, view.width - width + 1, 32)
    ]
    return max(places, key=lambda place: float(reference[place].std()))


def draw(view: View, panels: list[dict[str, Any]]) -> bytes:
    """PNG: each panel with its DSSIM and difference, and the reference; a part of the view."""
    from matplotlib.figure import Figure

    part = telling(view)
    reference = view.exposed(view.reference)[part]
    shown: list[tuple[Any, Any, str, str]] = []
    for panel in panels:
        image = view.exposed(panel["image"])[part]
        note = f"DSSIM {panel['dssim']:.4f}   {panel['ms']:.3g} ms"
        above, below = pictures.of_effect(image, view.effect), pictures.difference(image, reference)
        shown.append((above, below, panel["name"], note))
    below = np.full((*reference.shape[1:], 3), 255, np.uint8)
    if "normal" in view.attributes:
        below = pictures.normals(view.attributes["normal"][part])
    shown.append((pictures.of_effect(reference, view.effect), below, "reference", ""))
    with themed():
        figure = Figure(figsize=(2.1 * len(shown), 4.9), layout="constrained")
        axes = figure.subplots(2, len(shown), squeeze=False)
        for column, (above, below, name, note) in enumerate(shown):
            for axis, image in zip(axes[:, column], (above, below), strict=True):
                axis.imshow(image, interpolation="antialiased")
                axis.set_axis_off()
            axes[0, column].set_title(name, fontsize=10, fontweight="bold", loc="left")
            axes[1, column].set_title(note, fontsize=8, color=colour("ink"), loc="left")
        return png(figure)
