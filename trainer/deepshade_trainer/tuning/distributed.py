"""The steps of a job on Ray Train: the same batches, shared by several processes."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deepshade.errors import DataError
from deepshade.extras import install_command
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.tuning.events import EventLog, read_events
from deepshade_trainer.tuning.plan import Plan
from deepshade_trainer.tuning.steps import own_parts, training

FAILURES = 3  # of processes that are borne
POLL = 0.5  # seconds


def train_together(plan: Plan, recipe: Recipe, run: Run) -> Iterator[dict[str, Any]]:
    """Train in `plan.processes` processes of a Ray cluster, $RAY_ADDRESS's or one begun here.

    Each takes its part of every batch, and gradients are averaged over all, so that the result is
    that of one process but for the order of sums. All nodes must see the folders under the same
    paths. A process that dies is replaced, and all go on at the last checkpoint. Yields the first
    process's events. Raises DataError where Ray Train isn't installed or gives up.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_TRAIN_V2_ENABLED", "1")
    try:
        import ray
        from ray.train import FailureConfig, RunConfig, ScalingConfig
        from ray.train.torch import TorchTrainer
    except ImportError as error:
        raise DataError("Ray Train isn't installed", fix=install_command("cluster")) from error
    folder = run.folder.resolve()
    EventLog(folder)  # which mends what a killed process left
    offset = read_events(folder)[1]
    address = os.environ.get("RAY_ADDRESS")
    options: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    if address is None:
        options |= {"include_dashboard": False, "num_cpus": plan.processes * plan.threads}
    ray.init(address=address or "local", **options)
    trainer = TorchTrainer(
        _loop,
        train_loop_config={"plan": asdict(plan), "recipe": asdict(recipe), "run": str(folder)},
        scaling_config=ScalingConfig(
            num_workers=plan.processes, resources_per_worker={"CPU": plan.threads}
        ),
        run_config=RunConfig(
            name="deepshade",
            storage_path=str(folder / "ray"),
            failure_config=FailureConfig(max_failures=FAILURES),
        ),
    )
    try:
        with ThreadPoolExecutor(1) as pool:
            fitted = pool.submit(trainer.fit)
            while True:
                ended = fitted.done()
                events, offset = read_events(folder, 0, offset)
                yield from events
                if ended:
                    break
                time.sleep(POLL)
        if (failure := fitted.exception()) is not None:
            raise DataError(f"Ray Train gave up: {failure}") from failure
    finally:
        ray.shutdown()


def _loop(config: dict[str, Any]) -> None:
    """What each process does."""
    import torch
    from torch import distributed

    lists = {name: tuple(config["plan"][name]) for name in ("data", "rehearsal", "test")}
    plan = Plan(**{**config["plan"], **lists})
    run = Run(Path(config["run"]))
    torch.set_num_threads(plan.threads)
    log = EventLog(run.folder) if distributed.get_rank() == 0 else None
    for event in training(plan, Recipe().changed(**config["recipe"]), run, own_parts(plan)):
        if log is not None:
            log.add(event)
