"""Tunes HBAO and GTAO for the best mean SSIM: `python -m deepshade_report.baselines.ao.tuning`.

The sweep is seeded. A third of its time draws all parameters at random; the rest changes one to
three parameters of the best set found so far, by steps that shrink as time goes by. To try many
sets, each is scored on windows of the views, the same for all and beside the sources' own
parameters; what wins is scored on the whole views at every setting. The data has to be apart from
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

import numpy as np
import torch
from numpy.typing import NDArray

from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade.manifest import Manifest
from deepshade.metrics import ssim
from deepshade_report.baselines.ao import gtao, hbao
from deepshade_report.baselines.ao.horizons import Field, open_field
from deepshade_report.method import Float, View
from deepshade_report.views import load_views

WINDOW, MARGIN = 64, 8  # pixels that are compared, and around them those that the filter may read
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
    """A method to tune: its kernel, the sources' parameters, what may change, where to tune it.

    `at` are the numbers of directions or slices and of steps; `settings` all that get scored.
    """

    name: str
    shade: Callable[[Field, int, int, Any], Float]
    published: Any
    ranges: Ranges
    at: tuple[int, int]
    settings: Sequence[tuple[int, int]]


SUBJECTS = (
    Subject(
        "hbao",
        hbao.occlude,
        hbao.Parameters(),
        {**_SHARED, "bias": (0.0, 0.6, False)},
        (8, 4),
        hbao.SETTINGS,
    ),
    Subject(
        "gtao",
        gtao.occlude,
        gtao.Parameters(),
        {
            **_SHARED,
            "bias": (0.0, 0.3, False),
            "thickness": (0.0, 0.5, False),
            "thin": (0.0, 1.5, False),
        },
        (3, 5),
        gtao.SETTINGS,
    ),
)


@dataclass(frozen=True)
class Excerpt:
    """Windows of a view, as slices of rows and columns, and the field that computes just them."""

    field: Field
    windows: list[tuple[slice, slice]]
    reference: Float


def tune(
    subject: Subject,
    views: Sequence[View],
    *,
    seconds: float,
    seed: int,
    windows: int = 6,
    start: Any = None,
) -> dict[str, Any]:
    """The best parameters found within about `seconds`, and how every setting scores with them.

    From parameters to `start` with, there are no random draws, and smaller steps.
    """
    rng = random.Random(f"{seed} {subject.name}")
    excerpts = [_excerpt(view, windows, rng) for view in views]

    def score(parameters: Any) -> float:
        return fmean(
            ssim(image[window], excerpt.reference[window])
            for excerpt in excerpts
            for image in [subject.shade(excerpt.field, *subject.at, parameters)]
            for window in excerpt.windows
        )

    began, trials = time.monotonic(), 1
    first = score(subject.published)
    best, reached = (subject.published, first) if start is None else (start, score(start))
    random_share, widest = (_RANDOM_SHARE, 0.5) if start is None else (0.0, 0.25)
    while (gone := (time.monotonic() - began) / seconds) < 1:
        if gone < random_share:
            names, reach = list(subject.ranges), math.inf
        else:
            names = rng.sample(list(subject.ranges), rng.randint(1, 3))
            reach = widest * (1 - gone) + 0.02
        candidate = _changed(best, subject.ranges, names, reach, rng)
        found = score(candidate)
        trials += 1
        if found > reached:
            best, reached = candidate, found
            print(f"{subject.name} {gone:4.0%} {found:.4f} {asdict(best)}", flush=True)
    return {
        "parameters": asdict(best),
        "tuned_at": list(subject.at),
        "trials": trials,
        "windows": {"ssim": round(reached, 5), "published": round(first, 5)},
        "table": _table(subject, best, views),
    }


def _table(subject: Subject, best: Any, views: Sequence[View]) -> list[dict[str, Any]]:
    """Mean SSIM of every setting over whole views."""
    fields = [open_field(view) for view in views]
    rows = []
    for count, steps in subject.settings:
        reached = fmean(
            ssim(subject.shade(field, count, steps, best), view.reference)
            for field, view in zip(fields, views, strict=True)
        )
        rows.append({"setting": [count, steps], "ssim": round(reached, 5)})
        print(f"{subject.name} {count} x {steps}: {reached:.5f}", flush=True)
    return rows


def _changed(base: Any, ranges: Ranges, names: list[str], reach: float, rng: random.Random) -> Any:
    """`base` with some parameters moved by up to `reach` of their range, or anywhere for inf."""
    moved: dict[str, float | int] = {}
    for name in names:
        low, high, ratios = ranges[name]
        if ratios:
            low, high = math.log(low), math.log(high)
        now = getattr(base, name)
        at = (math.log(now) if ratios else now) if reach < math.inf else 0.0
        step = reach * (high - low) if reach < math.inf else math.inf
        value = rng.uniform(max(low, at - step), min(high, at + step))
        value = math.exp(value) if ratios else value
        moved[name] = round(value) if name == "blur" else float(f"{value:.4g}")
    return replace(base, **moved)


def _excerpt(view: View, count: int, rng: random.Random) -> Excerpt:
    """`count` windows of `view` that show geometry; all of it where the view is too small."""
    height, width = view.background.shape
    windows: list[tuple[slice, slice]] = []
    mask: NDArray[np.bool_] = np.zeros((height, width), bool)
    for _ in range(20 * count):
        top = rng.randint(0, max(height - WINDOW, 0))
        left = rng.randint(0, max(width - WINDOW, 0))
        window = (slice(top, top + WINDOW), slice(left, left + WINDOW))
        if len(windows) < count and not view.background[window].all():
            windows.append(window)
            mask[
                max(top - MARGIN, 0) : top + WINDOW + MARGIN,
                max(left - MARGIN, 0) : left + WINDOW + MARGIN,
            ] = True
    return Excerpt(open_field(view).within(mask), windows, view.reference)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m deepshade_report.baselines.ao.tuning",
        description="Tunes HBAO and GTAO for the best mean SSIM on a data set.",
    )
    parser.add_argument("--data", type=Path, required=True, help="what 'deepshade datagen' wrote")
    parser.add_argument("--out", type=Path, required=True, help="where the result goes (JSON)")
    parser.add_argument("--seconds", type=float, default=600.0, help="search time of each method")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--windows", type=int, default=6, help="windows of each view")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--start", type=Path, help="an earlier result to go on from")
    parser.add_argument("--only", choices=[s.name for s in SUBJECTS], help="the method to tune")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    try:
        views = load_views(options.data)
        result: dict[str, Any] = {} if options.start is None else _read(options.start)
        result["data"] = {
            "views": len(views),
            "datagen": Manifest.read(options.data).settings,
            "size": list(views[0].background.shape),
            "scenes": [view.scene for view in views],
        }
        command = (
            "python -m deepshade_report.baselines.ao.tuning --data DATA --out tuned.json"
            f" --seconds {options.seconds:g} --seed {options.seed} --windows {options.windows}"
        )
        with torch.inference_mode():
            for subject in SUBJECTS:
                if options.only not in (None, subject.name):
                    continue
                earlier = result.get(subject.name)
                start = earlier and replace(subject.published, **earlier["parameters"])
                result[subject.name] = {
                    "commands": [
                        *(earlier["commands"] if earlier else []),
                        f"{command} --only {subject.name}" + " --start tuned.json" * bool(earlier),
                    ],
                    **tune(
                        subject,
                        views,
                        seconds=options.seconds,
                        seed=options.seed,
                        windows=options.windows,
                        start=start,
                    ),
                }
        with replacing(options.out) as part:
            part.write_text(json.dumps(result, indent=1) + "\n", "utf-8")
    except DeepshadeError as error:
        parser.exit(1, f"{error}\n{error.fix}\n")
    return 0


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
        return {name: found[name] for name in found if name in {s.name for s in SUBJECTS}}
    except (OSError, ValueError, TypeError) as error:
        raise DeepshadeError(f"{path} holds no earlier result: {error}") from error


if __name__ == "__main__":
    raise SystemExit(main())
