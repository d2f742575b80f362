"""The steps of a job on Ray Train: the same batches, shared by several processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.tuning.events import EventLog, read_events
from deepshade_trainer.tuning.plan import Plan


def train_together(plan: Plan, recipe: Recipe, run: Run) -> Iterator[dict[str, Any]]:
    """Train in `plan.processes` processes of a Ray cluster, $RAY_ADDRESS's or one begun here.

    Each takes its part of every batch, and gradients are averaged over all, so that the result is
    that of one process but for the order of sums. All nodes must see the folders under the same
    paths. A process that dies is replaced, and all go on at the last checkpoint. Raises what
    training does, as Ray's error.
    """
    import ray
    from ray.train import FailureConfig, RunConfig, ScalingConfig
    from ray.train.torch import TorchTrainer

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_TRAIN_V2_ENABLED", "1")
    folder = run.folder.resolve()
    begun = EventLog(folder)
    _, offset = read_events(folder)
    ray.init(
        address=os.environ.get("RAY_ADDRESS") or "local",
        logging_level="ERROR",
        log_to_driver=False,
        include_dashboard=None if os.environ.get("RAY_ADDRESS") else False,
    )
    del begun
    try:
        TorchTrainer(
            _loop,
            train_loop_config={"plan": asdict(plan), "recipe": asdict(recipe), "run": str(folder)},
            scaling_config=ScalingConfig(
                num_workers=plan.processes, resources_per_worker={"CPU": plan.threads}
            ),
            run_config=RunConfig(
                name="deepshade",
                storage_path=str(folder / "ray"),
                failure_config=FailureConfig(max_failures=3),
            ),
        ).fit()
    finally:
        ray.shutdown()
    events, _ = read_events(folder, 0, offset)
    yield from events


def _loop(config: dict[str, Any]) -> None:
    """What each process does."""
    import torch
    from torch import distributed

    from deepshade_trainer.tuning.finetune import own_parts, training

    lists = {name: tuple(config["plan"][name]) for name in ("data", "rehearsal", "test")}
    plan = Plan(**{**config["plan"], **lists})
    run = Run(Path(config["run"]))
    torch.set_num_threads(plan.threads)
    log = EventLog(run.folder) if distributed.get_rank() == 0 else None
    for event in training(plan, Recipe().changed(**config["recipe"]), run, own_parts(plan)):
        if log is not None:
            log.add(event)
