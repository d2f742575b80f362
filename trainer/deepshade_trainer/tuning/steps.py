"""The steps of a fine-tuning job, on one process or on each of several."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.training import Every, Progress, train
from deepshade_trainer.tuning.parts import Parts
from deepshade_trainer.tuning.plan import Plan

Event = dict[str, Any]

VALIDATIONS, SAVES = 12, 25  # in a job, at most about


def own_parts(plan: Plan) -> Parts:
    """Which of a job's views are for what."""
    return Parts.of(dataset_of(plan), plan.data, plan.seed)


def training(plan: Plan, recipe: Recipe, run: Run, parts: Parts) -> Iterator[Event]:
    """The steps, each as an event, with time left and, now and then, a validation."""
    every = Every(_share(recipe.steps, SAVES), _share(recipe.steps, VALIDATIONS))
    begun, first = 0.0, 0  # of the first step that is timed
    steps = train(
        recipe,
        folders_of(plan),
        run,
        split=lambda _: (parts.mixed(plan.share), parts.judges),
        every=every,
    )
    for progress in steps:
        if progress.step and not first:
            begun, first = time.monotonic(), progress.step
        yield _event(progress, time.monotonic() - begun, first)


def folders_of(plan: Plan) -> list[Path]:
    """A job's own data, and what it is reminded of."""
    return [Path(each) for each in (*plan.data, *plan.rehearsal)]


def dataset_of(plan: Plan) -> Dataset:
    """All of them as one."""
    per_channel = bool(Bundle.load(Path(plan.base)).per_channel)
    return Dataset(folders_of(plan), plan.effect, per_channel=per_channel)


def _event(progress: Progress, seconds: float, first: int) -> Event:
    done = progress.step - first
    rate = done / seconds if first and done else None
    event: Event = {
        "phase": "training",
        "step": progress.step,
        "steps": progress.steps,
        "loss": progress.loss if math.isfinite(progress.loss) else None,
        "rate": rate,
        "left": (progress.steps - progress.step) / rate if rate else None,
    }
    if progress.figures:
        event |= {"validation": progress.figures, "preview": True}
    if progress.warning:
        event["warning"] = progress.warning
    return event


def _share(steps: int, count: int) -> int:
    return max(1, round(steps / count))
