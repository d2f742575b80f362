"""What methods answer to views, and their mean errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

from deepshade.timing import significant
from deepshade_report.method import Method
from deepshade_report.view import Float, View


def answers(methods: Mapping[str, Method], view: View) -> Iterator[tuple[str, Float]]:
    """Each method's answer to a view, shaped as the reference."""
    for name, method in methods.items():
        method.prepare(view)
        yield name, method.shade(view).reshape(view.reference.shape)


def means(methods: Mapping[str, Method], views: Sequence[View]) -> dict[str, Any]:
    """Mean DSSIM by method, with "nothing" for the trivial answer, and what noise leaves of it."""
    found: dict[str, list[float]] = {}
    for view in views:
        found.setdefault("nothing", []).append(view.dssim(view.trivial()))
        for name, image in answers(methods, view):
            found.setdefault(name, []).append(view.dssim(image))
    floors = [floor for view in views if (floor := view.floor()) is not None]
    return {
        "dssim": {name: significant(fmean(each)) for name, each in found.items()},
        "noise": significant(fmean(floors)) if floors else None,
        "contrast": significant(fmean(view.contrast() for view in views)),
        "views": len(views),
    }
