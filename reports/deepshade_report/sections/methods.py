"""Error and speed of every method: the sections `error` and `speed`."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import fmean
from typing import Any

import numpy as np

from deepshade import metrics
from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError
from deepshade_report import baselines as contenders
from deepshade_report import frames
from deepshade_report.context import Context
from deepshade_report.method import Method, View
from deepshade_report.statistics import significant, spread
from deepshade_report.subjects import Network, identity, networks
from deepshade_report.timing import alternate

_SPEED_SECONDS = 100.0


def methods(context: Context) -> tuple[list[Method], dict[str, str]]:
    """All that this machine can compare, and what is missing with the reason."""
    found: list[Method] = list(networks(context.served, context.baseline, context.threads))
    others, missing = contenders.rivals(context.quick)
    if context.baseline is None:
        missing["the paper's network"] = "no bundle of it: name one with --paper"
    return [*found, *others], missing


def error(context: Context) -> dict[str, Any]:
    """Mean DSSIM and SSIM of every method over the held-out views, beside the trivial answer's."""
    views = context.held_out
    found, missing = methods(context)
    white = [dssim(np.full_like(view.reference, _blank(context)), view) for view in views]
    errors: dict[str, list[float]] = {identity(method): [] for method in found}
    for number, view in enumerate(views):  # outermost: what traces rays keeps a view's scene
        for index, method in enumerate(found):
            name = identity(method)
            if name in missing:
                continue
            context.advance((number + index / len(found)) / len(views), f"{view.scene}: {name}")
            try:
                method.prepare(view)
                errors[name].append(dssim(method.shade(view), view))
            except DeepshadeError as problem:
                missing[name] = str(problem)
    rows = [
        {
            **about(method),
            "dssim": significant(fmean(each)),
            "ssim": significant(1 - 2 * fmean(each)),
            "of_trivial": significant(fmean(each) / fmean(white)),
            "each": [significant(value) for value in each],
        }
        for method in found
        if len(each := errors[identity(method)]) == len(views)
    ]
    return {
        "views": len(views),
        "scenes": sorted({view.scene for view in views}),
        "size": list(views[0].background.shape),
        "trivial_dssim": significant(fmean(white)),
        "rows": rows,
        "missing": missing,
    }


def speed(context: Context) -> dict[str, Any]:
    """Milliseconds of every method, warm, in alternating rounds, on a real 768 x 512 frame."""
    view = frames.fullest(context.held_out)
    frame = frames.extended(view, frames.HEIGHT, frames.WIDTH)
    found, missing = methods(context)
    tasks: dict[str, Callable[[], object]] = {}
    megapixels: dict[str, float] = {}
    kept: dict[str, Method] = {}
    for method in found:
        name = identity(method)
        # tracing rays needs the scene's own geometry, so a view as it was rendered
        shown = view if contenders.needs_scene(method) else frame
        try:
            context.advance(0.0, f"preparing {name}")
            method.prepare(shown)
            tasks[name] = _bound(method, shown)
            tasks[name]()
        except DeepshadeError as problem:
            tasks.pop(name, None)
            missing[name] = str(problem)
            continue
        megapixels[name] = shown.background.size / 1e6
        kept[name] = method
    began = time.perf_counter()
    times = alternate(tasks, context.pace(_SPEED_SECONDS), advance=context.advance)
    rows = []
    for name, method in kept.items():
        scale = frames.MEGAPIXELS / megapixels[name]
        rounds = [significant(value * scale) for value in times[name]]
        rows.append(
            {
                **about(method),
                "ms": spread(rounds),
                "ms_per_megapixel": significant(spread(rounds)["median"] / frames.MEGAPIXELS),
                "scaled_from_megapixels": None if scale == 1 else significant(megapixels[name]),
                "rounds": rounds,
            }
        )
    return {
        "frame": [frames.WIDTH, frames.HEIGHT],
        "background": significant(frame.background.mean()),
        "seconds": significant(time.perf_counter() - began),
        "rows": rows,
        "missing": missing,
    }


def about(method: Method) -> dict[str, Any]:
    """Who a row is about."""
    row: dict[str, Any] = {
        "id": identity(method),
        "name": method.name,
        "family": method.family,
        "settings": {key: _plain(value) for key, value in method.settings.items()},
    }
    if isinstance(method, Network):
        row["sha256"] = method.bundle.sha256
    return row


def dssim(image: Any, view: View) -> float:
    """DSSIM against the view's reference, both clamped to [0, 1]."""
    return metrics.dssim(np.clip(image, 0, 1), np.clip(view.reference, 0, 1))


def _blank(context: Context) -> float:
    return EFFECTS[context.effect].background


def _bound(method: Method, view: View) -> Callable[[], object]:
    return lambda: method.shade(view)


def _plain(value: object) -> object:
    return value if isinstance(value, (str, int, float, bool)) or value is None else str(value)
