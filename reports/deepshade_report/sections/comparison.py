"""One real view by each method, side by side: the section `comparison` and its picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import pictures
from deepshade.errors import DeepshadeError
from deepshade.timing import significant
from deepshade_report.context import Context
from deepshade_report.plots import PALETTE, png, themed
from deepshade_report.sections import Skipped, points, standing_for, title
from deepshade_report.sections.methods import methods, shaded
from deepshade_report.view import Float, View

PICTURE = "comparison.png"
_MAX_BACKGROUND = 0.15


def comparison(context: Context) -> dict[str, Any]:
    """Figures of the panels; draws `PICTURE` into the report's folder.

    Networks run on their default backends and the screen-space methods with their best settings,
    as the sections `error` and `speed` found them. Raises Skipped without those.
    """
    chosen = standing_for(points(context.measured)).values()
    if not chosen:
        raise Skipped("it needs the sections error and speed")
    views = [view for view in context.views if view.background.mean() <= _MAX_BACKGROUND]
    views = sorted(views or context.views, key=View.contrast)
    view = views[len(views) // 2]
    found, _ = methods(context)
    panels: list[dict[str, Any]] = []
    images: list[Float] = []
    for point in chosen:
        method = found.get(point.id)
        if method is None or getattr(method, "needs_scene", False):
            continue
        context.advance(len(panels) / len(chosen), point.id)
        try:
            method.prepare(view)
            images.append(shaded(method, view))
        except DeepshadeError:
            continue
        dssim = significant(view.dssim(images[-1]))
        panel = {"id": point.id, "name": title(point.name), "dssim": dssim}
        panels.append(panel | {"ms": significant(point.milliseconds)})
    context.out.mkdir(parents=True, exist_ok=True)
    (context.out / PICTURE).write_bytes(draw(view, panels, images))
    return {"scene": view.scene, "picture": PICTURE, "panels": panels}


def draw(view: View, panels: list[dict[str, Any]], images: list[Float]) -> bytes:
    """PNG: each panel's image (C, H, W) over its difference, reference over normals or light."""
    from matplotlib.figure import Figure

    reference = view.exposed(view.reference)
    columns: list[tuple[NDArray[np.uint8], NDArray[np.uint8], str, str]] = []
    for panel, image in zip(panels, images, strict=True):
        shown = view.exposed(image)
        below = pictures.difference(shown, reference)
        note = f"DSSIM {panel['dssim']:.4f}   {panel['ms']:.3g} ms"
        columns.append((pictures.of_effect(shown, view.effect), below, panel["name"], note))
    below = np.full((*reference.shape[1:], 3), 255, np.uint8)
    if "normal" in view.attributes:
        below = pictures.normals(view.attributes["normal"])
    elif (light := view.light()) is not None:
        below = pictures.of_effect(view.exposed(light), view.effect)
    columns.append((pictures.of_effect(reference, view.effect), below, "reference", ""))
    with themed():
        figure = Figure(figsize=(2.6 * len(columns), 5.9), layout="constrained")
        axes = figure.subplots(2, len(columns), squeeze=False)
        for (upper, lower), (above, below, name, note) in zip(axes.T, columns, strict=True):
            upper.imshow(above, interpolation="antialiased")
            upper.set_title(name, fontsize=10, fontweight="bold", loc="left")
            lower.imshow(below, interpolation="antialiased")
            lower.set_title(note, fontsize=8, color=PALETTE["ink"], loc="left")
        for axis in axes.flat:
            axis.set_axis_off()
        return png(figure)
