"""Tunes HBAO and GTAO for the least mean DSSIM: `python -m deepshade_report.baselines.ao.tuning`.

A seeded search over all parameters. A third of its time draws them at random; the rest changes one
to three of the best set so far, by steps that shrink as time goes by. The data has to be apart from
what a report measures on.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade_report.baselines.ao import gtao, hbao
from deepshade_report.baselines.ao.screen import Marching
from deepshade_report.view import View, load_views

_RANDOM_SHARE = 1 / 3

# name -> smallest, largest, and whether steps are ratios
Ranges = Mapping[str, tuple[float, float, bool]]
_SHARED: Ranges = {
    "radius": (0.4, 2.5, True),
    "falloff": (0.05, 1.0, True),
    "intensity": (0.5, 2.5, True),
    "power": (0.4, 2.5, True),
    "spread": (1.0, 2.5, False),
    "blur": (0, 6, False),
    "edge": (0.02, 0.5, True),
}


@dataclass(frozen=True)
class Subject:
    """A method to tune: how it is made, the sources' parameters, what may change.

    `at` are the numbers of directions or slices and of steps to tune it at.
    """

    make: Callable[[int, int, Any], Marching]
    published: Any
    ranges: Ranges
    at: tuple[int, int]


_HBAO = {**_SHARED, "bias": (0.0, 0.6, False)}
_GTAO = {**_SHARED, "bias": (0.0, 0.3, False)}
_GTAO |= {"thickness": (0.0, 0.5, False), "thin": (0.0, 1.5, False)}
SUBJECTS = {
    "hbao": Subject(hbao.HBAO, hbao.Parameters(), _HBAO, hbao.SETTINGS[2]),
    "gtao": Subject(gtao.GTAO, gtao.Parameters(), _GTAO, gtao.SETTINGS[3]),
}


def tune(subject: Subject, views: Sequence[View], seconds: float, seed: int) -> dict[str, Any]:
    """The best parameters found within about `seconds`, and their error beside the sources' own."""
    rng = random.Random(seed)

    def error(parameters: Any) -> float:
        method = subject.make(*subject.at, parameters)
        found = []
        for view in views:
            method.prepare(view)
            found.append(view.dssim(method.shade(view)[None]))
        return fmean(found)

    began, trials = time.monotonic(), 1
    first = error(subject.published)
    best, least = subject.published, first
    while (gone := (time.monotonic() - began) / seconds) < 1:
        names, reach = list(subject.ranges), math.inf
        if gone >= _RANDOM_SHARE:
            names = rng.sample(names, rng.randint(1, 3))
            reach = 0.5 * (1 - gone) + 0.02
        candidate = changed(best, subject.ranges, names, reach, rng)
        found = error(candidate)
        trials += 1
        if found < least:
            best, least = candidate, found
            print(f"{gone:4.0%} {least:.5f} {asdict(best)}", flush=True)
    return {
        "parameters": asdict(best),
        "tuned_at": list(subject.at),
        "trials": trials,
        "dssim": {"tuned": round(least, 5), "published": round(first, 5)},
    }


def changed(base: Any, ranges: Ranges, names: list[str], reach: float, rng: random.Random) -> Any:
    """`base` with some parameters moved by up to `reach` of their range, or anywhere for inf."""
    moved: dict[str, float | int] = {}
    for name in names:
        low, high, ratios = ranges[name]
        now = getattr(base, name)
        if ratios:
            low, high, now = math.log(low), math.log(high), math.log(now)
        if reach < math.inf:
            step = reach * (high - low)
            low, high = max(low, now - step), min(high, now + step)
        value = math.exp(rng.uniform(low, high)) if ratios else rng.uniform(low, high)
        moved[name] = round(value) if name == "blur" else float(f"{value:.4g}")
    return replace(base, **moved)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns its exit status."""
    parser = argparse.ArgumentParser(description="Tunes HBAO and GTAO on a data set.")
    parser.add_argument("--data", type=Path, required=True, help="what 'deepshade datagen' wrote")
    parser.add_argument("--out", type=Path, required=True, help="where the result goes (JSON)")
    parser.add_argument("--seconds", type=float, default=600.0, help="search time of each method")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        views = load_views(options.data, "ao")
        result: dict[str, Any] = {"scenes": [view.scene for view in views]}
        for name, subject in SUBJECTS.items():
            result[name] = tune(subject, views, options.seconds, options.seed)
        with replacing(options.out) as part:
            part.write_text(json.dumps(result, indent=1) + "\n", "utf-8")
    except DeepshadeError as error:
        parser.exit(1, f"{error}\n{error.fix}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
