"""Error and speed of every method: the sections `error` and `speed`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from statistics import fmean, stdev
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.timing import alternate, significant, spread
from deepshade_report.baselines import baselines
from deepshade_report.context import Context
from deepshade_report.method import Method, Network, identity, networks
from deepshade_report.view import HEIGHT, MEGAPIXELS, WIDTH, View, fullest, resized

_SPEED_SECONDS = 100.0


def methods(context: Context) -> tuple[dict[str, Method], dict[str, str]]:
    """All that this machine can compare, by identity, and what is missing with the reason."""
    own = networks(context.served, context.paper_network, context.threads)
    others, missing = baselines(context.effect, context.quick, context.threads)
    if context.paper_network is None:
        missing["the paper's network"] = "no bundle of it: name one with --paper"
    return {identity(method): method for method in (*own, *others)}, missing


def error(context: Context) -> dict[str, Any]:
    """Mean DSSIM of every method over the held-out views, beside the trivial answer's."""
    views = context.views
    found, missing = methods(context)
    nothing = [view.dssim(view.trivial()) for view in views]
    trivial = fmean(nothing)
    errors: dict[str, list[float]] = {name: [] for name in found}
    relative: dict[str, list[float]] = {name: [] for name in found}  # of light only
    for number, view in enumerate(views):  # outermost: what traces rays keeps a view's scene
        for index, (name, method) in enumerate(found.items()):
            if name in missing:
                continue
            context.advance((number + index / len(found)) / len(views), f"{view.scene}: {name}")
            try:
                method.prepare(view)
                image = shaded(method, view)
                errors[name].append(significant(view.dssim(image)))
                if view.effect.is_light:
                    relative[name].append(view.relative(image))
            except DeepshadeError as problem:
                missing[name] = str(problem)
    rows = []
    for name, each in errors.items():
        if name not in missing:
            mean = fmean(each)
            about = {"dssim": significant(mean), "of_trivial": significant(mean / trivial)}
            beside = {"standard_error": standard_error(each), "relative": mean_of(relative[name])}
            rows.append({**facts(found[name]), **about, **beside, "each": each})
    return {
        "views": len(views),
        "scenes": sorted({view.scene for view in views}),
        "size": [views[0].width, views[0].height],
        "trivial_dssim": significant(trivial),
        "trivial_standard_error": standard_error(nothing),
        "floor": mean_of([value for view in views if (value := view.floor()) is not None]),
        "trivial_relative": mean_of([v.relative(v.trivial()) for v in views if v.effect.is_light]),
        "rows": rows,
        "missing": missing,
    }


def speed(context: Context) -> dict[str, Any]:
    """Milliseconds of every method, warm, in turns, on a real 768 x 512 frame."""
    view = fullest(context.views)
    frame = resized(view)
    found, missing = methods(context)
    tasks: dict[str, Callable[[], object]] = {}
    megapixels: dict[str, float] = {}
    for name, method in found.items():
        # tracing rays needs the scene's own geometry, so a view as it was rendered
        shown = view if getattr(method, "needs_scene", False) else frame
        context.advance(0.0, f"preparing {name}")
        try:
            method.prepare(shown)
            method.shade(shown)
        except DeepshadeError as problem:
            missing[name] = str(problem)
            continue
        tasks[name] = partial(method.shade, shown)
        megapixels[name] = shown.background.size / 1e6
    times = alternate(tasks, context.pace(_SPEED_SECONDS), advance=context.advance)
    rows = []
    for name, figures in times.items():
        ms = spread([value * MEGAPIXELS / megapixels[name] for value in figures["ms"]])
        per_megapixel = significant(ms["median"] / MEGAPIXELS)
        rows.append({**facts(found[name]), "ms": ms, "ms_per_megapixel": per_megapixel})
    return {
        "frame": [WIDTH, HEIGHT],
        "background": significant(frame.background.mean()),
        "rows": rows,
        "missing": missing,
    }


def shaded(method: Method, view: View) -> Any:
    """(C, H, W) of the prepared view."""
    return method.shade(view).reshape(view.reference.shape)


def mean_of(each: Sequence[float]) -> float | None:
    """The mean, None of nothing."""
    return significant(fmean(each)) if each else None


def standard_error(each: Sequence[float]) -> float | None:
    """That of the mean over views, None of a single one."""
    return significant(stdev(each) / math.sqrt(len(each))) if len(each) > 1 else None


def facts(method: Method) -> dict[str, Any]:
    """Which method a row is about."""
    row: dict[str, Any] = {"id": identity(method), "name": method.name, "family": method.family}
    row["settings"] = method.settings
    return row | ({"sha256": method.bundle.sha256} if isinstance(method, Network) else {})
