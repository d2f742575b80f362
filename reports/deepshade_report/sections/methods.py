"""Error and speed of every method: the sections `error` and `speed`."""

from __future__ import annotations

from collections.abc import Callable
from statistics import fmean
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade_report.baselines import baselines
from deepshade_report.context import Context
from deepshade_report.method import Method, Network, identity, networks
from deepshade_report.timing import alternate, significant, spread
from deepshade_report.view import HEIGHT, MEGAPIXELS, WIDTH, View, fullest, resized

_SPEED_SECONDS = 100.0


def methods(context: Context) -> tuple[list[Method], dict[str, str]]:
    """All that this machine can compare, and what is missing with the reason."""
    found: list[Method] = list(networks(context.served, context.paper_network, context.threads))
    others, missing = baselines(context.effect, context.quick)
    if context.paper_network is None:
        missing["the paper's network"] = "no bundle of it: name one with --paper"
    return [*found, *others], missing


def error(context: Context) -> dict[str, Any]:
    """Mean DSSIM of every method over the held-out views, beside the trivial answer's."""
    views = context.views
    found, missing = methods(context)
    trivial = fmean(view.dssim(view.trivial()) for view in views)
    errors: dict[str, list[float]] = {identity(method): [] for method in found}
    for number, view in enumerate(views):  # outermost: what traces rays keeps a view's scene
        for index, method in enumerate(found):
            name = identity(method)
            if name in missing:
                continue
            context.advance((number + index / len(found)) / len(views), f"{view.scene}: {name}")
            try:
                method.prepare(view)
                errors[name].append(view.dssim(shaded(method, view)))
            except DeepshadeError as problem:
                missing[name] = str(problem)
    rows = [
        {
            **about(method),
            "dssim": significant(fmean(each)),
            "of_trivial": significant(fmean(each) / trivial),
            "each": [significant(value) for value in each],
        }
        for method in found
        if len(each := errors[identity(method)]) == len(views)
    ]
    return {
        "views": len(views),
        "scenes": sorted({view.scene for view in views}),
        "size": [views[0].width, views[0].height],
        "trivial_dssim": significant(trivial),
        "rows": rows,
        "missing": missing,
    }


def speed(context: Context) -> dict[str, Any]:
    """Milliseconds of every method, warm, in turns, on a real 768 x 512 frame."""
    view = fullest(context.views)
    frame = resized(view)
    found, missing = methods(context)
    tasks: dict[str, Callable[[], object]] = {}
    kept: dict[str, tuple[Method, float]] = {}
    for method in found:
        name = identity(method)
        # tracing rays needs the scene's own geometry, so a view as it was rendered
        shown = view if getattr(method, "needs_scene", False) else frame
        context.advance(0.0, f"preparing {name}")
        try:
            method.prepare(shown)
            method.shade(shown)
        except DeepshadeError as problem:
            missing[name] = str(problem)
            continue
        tasks[name] = _bound(method, shown)
        kept[name] = method, shown.background.size / 1e6
    times = alternate(tasks, context.pace(_SPEED_SECONDS), advance=context.advance)
    rows = []
    for name, (method, megapixels) in kept.items():
        ms = [value * MEGAPIXELS / megapixels for value in times[name]["ms"]]
        rows.append(
            {
                **about(method),
                "ms": spread(ms),
                "ms_per_megapixel": significant(spread(ms)["median"] / MEGAPIXELS),
                "measured_megapixels": significant(megapixels),
            }
        )
    return {
        "frame": [WIDTH, HEIGHT],
        "background": significant(frame.background.mean()),
        "rows": rows,
        "missing": missing,
    }


def shaded(method: Method, view: View) -> Any:
    """(C, H, W) of the prepared view."""
    return method.shade(view).reshape(view.reference.shape)


def about(method: Method) -> dict[str, Any]:
    """Who a row is about."""
    row: dict[str, Any] = {"id": identity(method), "name": method.name, "family": method.family}
    row["settings"] = dict(method.settings)
    return row | ({"sha256": method.bundle.sha256} if isinstance(method, Network) else {})


def _bound(method: Method, view: View) -> Callable[[], object]:
    return lambda: method.shade(view)
