"""One real view by each method, side by side: the section `comparison` and its picture."""

from __future__ import annotations

from typing import Any

import numpy as np

from deepshade import pictures
from deepshade.engines import Backend, load_engine
from deepshade.errors import DeepshadeError
from deepshade_report import baselines as contenders
from deepshade_report import style
from deepshade_report.context import Context
from deepshade_report.method import Method, View
from deepshade_report.sections import (
    Sections,
    backend_of,
    best_rival,
    default_backend,
    network_row,
    rows,
)
from deepshade_report.sections.methods import dssim
from deepshade_report.statistics import significant
from deepshade_report.store import Skipped
from deepshade_report.style import colour, themed
from deepshade_report.subjects import PAPER, Network, identity

PICTURE = "comparison.png"
_CROP = 384  # pixels of the view that are shown, so that details can be seen
_MOST_BACKGROUND = 0.15


def comparison(context: Context, sections: Sections) -> tuple[dict[str, Any], bytes]:
    """Figures of the panels, and the picture: all methods, differences beneath, the reference.

    The networks run on their default backends and the rivals with their best settings, as the
    sections `error` and `speed` found them. Raises Skipped without those.
    """
    if not rows(sections, "error") or not rows(sections, "speed"):
        raise Skipped("it needs the sections error and speed")
    number = typical(sections, context.held_out)
    view = context.held_out[number]
    panels = []
    chosen = _methods(context, sections)
    for index, (label, method, row) in enumerate(chosen):
        context.advance(index / len(chosen), label)
        try:
            method.prepare(view)
            image = np.clip(np.asarray(method.shade(view), np.float32), 0, 1)
        except DeepshadeError:
            continue
        panels.append(
            {
                "label": label,
                "id": identity(method),
                "dssim": significant(dssim(image, view)),
                "ms": row["ms"]["median"] if row else None,
                "image": image,
            }
        )
    picture = draw(view, panels)
    figures = [{k: v for k, v in panel.items() if k != "image"} for panel in panels]
    return {"view": number, "scene": view.scene, "picture": PICTURE, "panels": figures}, picture


def typical(sections: Sections, views: list[View]) -> int:
    """The view whose errors, over the networks, are closest to the middle; little background."""
    networks = [row for row in rows(sections, "error", family="network") if row.get("each")]
    full = [n for n, view in enumerate(views) if view.background.mean() <= _MOST_BACKGROUND]
    full = full or list(range(len(views)))
    if not networks or any(len(row["each"]) != len(views) for row in networks):
        return full[0]
    share = np.mean([np.array(row["each"]) / row["dssim"] for row in networks], axis=0)
    return min(full, key=lambda n: abs(float(share[n]) - 1))


def telling(view: View) -> tuple[slice, slice]:
    """Rows and columns, at most 384 of each, where the reference varies most."""
    height, width = (min(size, _CROP) for size in view.background.shape)
    places = [
        (slice(top, top + height), slice(left, left + width))
        for top in range(0, view.height - height + 1, 32)
        for left in range(0, view.width - width + 1, 32)
    ]
    return max(places, key=lambda place: float(view.reference[place].std()))


def draw(view: View, panels: list[dict[str, Any]]) -> bytes:
    """PNG: normals, each panel with DSSIM and milliseconds, and the reference; differences below.

    A part of the view (see `telling`), at its own resolution.
    """
    from matplotlib.figure import Figure

    rows_, columns_ = telling(view)
    reference = view.reference[rows_, columns_]
    shown: list[tuple[Any, Any, str, str]] = []
    for panel in panels:
        image = panel["image"][rows_, columns_]
        ms = f"{panel['ms']:.3g} ms" if panel["ms"] is not None else ""
        shown.append(
            (
                pictures.shading(image),
                pictures.difference(image, reference),
                panel["label"],
                f"DSSIM {panel['dssim']:.4f}   {ms}",
            )
        )
    normals = pictures.normals(view.normal[:, rows_, columns_])
    shown.append((pictures.shading(reference), normals, "reference", "normals below"))
    with themed():
        figure = Figure(figsize=(2.1 * len(shown), 4.9), layout="constrained")
        axes = figure.subplots(2, len(shown), squeeze=False)
        for column, (above, below, title, note) in enumerate(shown):
            for axis, image in zip(axes[:, column], (above, below), strict=True):
                axis.imshow(image, interpolation="antialiased")
                axis.set_axis_off()
            axes[0, column].set_title(title, fontsize=10, fontweight="bold", loc="left")
            axes[1, column].set_title(note, fontsize=8, color=colour("ink"), loc="left")
        return style.png(figure)


def _methods(
    context: Context, sections: Sections
) -> list[tuple[str, Method, dict[str, Any] | None]]:
    found: list[tuple[str, Method, dict[str, Any] | None]] = []
    named = [(bundle.name, bundle) for bundle in context.served]
    if context.baseline:
        named.append((PAPER, context.baseline))
    for name, bundle in named:
        row = network_row(sections, "speed", name)
        backend = backend_of(row) if row else default_backend(sections, name)
        if backend is None:
            continue
        engine = load_engine(bundle, Backend(*backend.split("/", 1)), threads=context.threads)
        engine.warm()
        label = "the paper's network" if name == PAPER else name
        found.append((label, Network(bundle, engine, name), row))
    others, _ = contenders.rivals(context.quick)
    for word in ("hbao", "gtao"):
        best = best_rival(sections, word)
        for method in others:
            if best and identity(method) == best["id"]:
                times = rows(sections, "speed", id=best["id"])
                found.append((method.name, method, times[0] if times else None))
    if not found:
        raise Skipped("nothing to compare")
    return found
