"""Tunes an effect's baselines for the least mean DSSIM: `python -m deepshade_report.tuning --help`.

A seeded search over all parameters of a baseline. A third of its time draws them at random; the
rest changes one to three of the best set so far, by steps that shrink as time goes by. The data has
to be apart from what a report measures on. A baseline takes part that has a `TUNABLE`.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from typing import Any

from deepshade.files import replacing
from deepshade_report import baselines
from deepshade_report.method import Method
from deepshade_report.view import View, load_views

Ranges = dict[str, tuple[float, float]]  # by name, the smallest and largest


@dataclass(frozen=True)
class Tunable:
    """A method of given parameters (a dataclass), those of its sources, and what may change."""

    make: Callable[[Any], Method]
    published: Any
    ranges: Ranges


def tuned(package: str, name: str) -> dict[str, Any]:
    """A baseline's parameters that a search found, by name, from its package's tuned.json.

    None where no search has been made: those of the sources are left as they are.
    """
    source = files(package) / "tuned.json"
    found = json.loads(source.read_text("utf-8")) if source.is_file() else {}
    return dict(found.get(name, {}).get("parameters", {}))


def tune(subject: Tunable, views: Sequence[View], seconds: float, seed: int) -> dict[str, Any]:
    """The best parameters found within about `seconds`, and their error beside the sources' own."""
    rng = random.Random(seed)

    def error(parameters: Any) -> float:
        method, found = subject.make(parameters), []
        for view in views:
            method.prepare(view)
            found.append(view.dssim(method.shade(view).reshape(view.reference.shape)))
        return fmean(found)

    began, trials = time.monotonic(), 0
    best = subject.published
    least = published = error(best)
    while (gone := (time.monotonic() - began) / seconds) < 1:
        names, reach = list(subject.ranges), math.inf
        if gone >= 1 / 3:
            names = rng.sample(names, rng.randint(1, min(3, len(names))))
            reach = 0.5 * (1 - gone) + 0.02
        candidate = changed(best, subject.ranges, names, reach, rng)
        trials += 1
        if (found := error(candidate)) < least:
            best, least = candidate, found
            print(f"{gone:4.0%} {least:.5f} {asdict(best)}", flush=True)
    dssim = {"tuned": round(least, 5), "published": round(published, 5)}
    print("at an end of its range:", ", ".join(at_ends(best, subject.ranges)) or "none", flush=True)
    return {"parameters": asdict(best), "trials": trials, "dssim": dssim}


def at_ends(parameters: Any, ranges: Ranges) -> list[str]:
    """Which parameters lie within 2 % of an end of their range: it may be too narrow."""
    near = []
    for name, (low, high) in ranges.items():
        share = (getattr(parameters, name) - low) / (high - low)
        near += [f"{name} {getattr(parameters, name)}"] if not 0.02 < share < 0.98 else []
    return near


def changed(base: Any, ranges: Ranges, names: list[str], reach: float, rng: random.Random) -> Any:
    """`base` with some parameters moved by up to `reach` of their range, or anywhere for inf."""
    moved: dict[str, float | int] = {}
    for name in names:
        now, (low, high) = getattr(base, name), ranges[name]
        step = reach * (high - low)
        value = rng.uniform(max(low, now - step), min(high, now + step))
        moved[name] = round(value) if isinstance(now, int) else float(f"{value:.4g}")
    return replace(base, **moved)


def main() -> None:
    """The command: writes what a baseline's tuned.json holds."""
    parser = argparse.ArgumentParser(description="Tunes an effect's baselines on a data set.")
    parser.add_argument("--effect", default="ao")
    parser.add_argument("--data", type=Path, required=True, help="what 'deepshade datagen' wrote")
    parser.add_argument("--out", type=Path, required=True, help="where the result goes (JSON)")
    parser.add_argument("--seconds", type=float, default=600.0, help="search time of each method")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--views", type=int, help="at most; default: all that show something")
    options = parser.parse_args()
    views = load_views(options.data, options.effect, options.views)
    result: dict[str, Any] = {"scenes": [Path(view.scene).name for view in views]}
    for name in getattr(baselines.folder(options.effect), "METHODS", {}).values():
        module = import_module(f"{baselines.__name__}.{options.effect}.{name}")
        if subject := getattr(module, "TUNABLE", None):
            print(f"{name} on {len(views)} views", flush=True)
            result[name] = tune(subject, views, options.seconds, options.seed)
    with replacing(options.out) as part:
        part.write_text(json.dumps(result, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
