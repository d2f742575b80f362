"""One fine-tuning job, from a plan to a bundle and its decision; resumable at any moment."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from deepshade import bench
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import choose, load_engine
from deepshade.environments import black
from deepshade.errors import DataError
from deepshade.files import replacing
from deepshade.tensors import up
from deepshade.timing import Pace, alternate
from deepshade_trainer import card
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.evaluation import evaluate
from deepshade_trainer.export import export
from deepshade_trainer.networks import Shader, build, bundle_weights
from deepshade_trainer.recipe import Recipe, preset
from deepshade_trainer.run import Run, Tensors
from deepshade_trainer.training import train
from deepshade_trainer.tuning import shipped
from deepshade_trainer.tuning.distributed import train_together
from deepshade_trainer.tuning.finished import candidate
from deepshade_trainer.tuning.parts import MIN_JUDGES, Parts
from deepshade_trainer.tuning.plan import Plan, code, digest
from deepshade_trainer.tuning.steps import Event, dataset_of, folders_of, own_parts, training
from deepshade_trainer.tuning.verdict import FILE, Paired, Verdict
from deepshade_trainer.validation import validated

RATE = 8e-4  # of 2e-3, from which networks begin: what a base knows is kept, and yet it moves
EMA = 0.95
PILOT = 4  # steps, of which the first is not timed
USED = 0.85  # of the minutes are steps; the rest is for validation and saving
# How often a view of one's own is learnt from at most, however quick the machine. Of 56 views of a
# room, others of it had 28 % less error after 64 times, and 18 % after 264.
EPOCHS = 64
# How far from the base to the tuned weights, the farthest first, and how much of what a test may
# lose the reminders may.
BLENDS = (1.0, 0.8, 0.6, 0.4, 0.2)
MARGIN = 0.35
ROUNDS = 7  # of timing
TIMINGS = 3  # at most, where the machine is too busy for one to show that a candidate is in time


def finetune(plan: Plan, folder: Path) -> Iterator[Event]:
    """Tune, blend, export, judge. What a job begun before left in `folder` is gone on with.

    Yields events; the last has the `decision`, which lies beside the bundle too (`candidate`).
    Raises DeepshadeError for data or settings that don't do.
    """
    written = candidate(folder, plan) / FILE
    if written.exists():  # it comes last: all else is there
        yield {"phase": "judged", "decision": json.loads(written.read_text())}
        return
    folder.mkdir(parents=True, exist_ok=True)
    parts = own_parts(plan)
    recipe = yield from _recipe(plan, folder, parts)
    run = Run(folder / "run")
    if plan.processes > 1:
        yield from train_together(plan, recipe, run)
    else:
        yield from training(plan, recipe, run, parts)
    if run.load()[1] < recipe.steps:
        return  # asked to stop
    yield {"phase": "blending"}
    blended = _blend(plan, recipe, run, parts, folder)
    yield {"phase": "exporting", "blend": blended}
    bundle = _export(plan, folder)
    yield {"phase": "judging"}
    verdict = _judge(plan, bundle, parts, folder)
    base = Bundle.load(Path(plan.base))
    decision = {
        **verdict.document(),
        "base": {"name": base.name, "sha256": base.sha256},
        "candidate": {"name": bundle.name, "sha256": bundle.sha256},
        "data": {each: [digest(Path(f)) for f in getattr(plan, each)] for each in _PLACES[1:]},
        "code": code(),
        "steps": recipe.steps,
        "blend": blended,
        "plan": {k: v for k, v in asdict(plan).items() if k not in _PLACES},
    }
    with replacing(written) as temporary:
        temporary.write_text(json.dumps(decision, indent=2, allow_nan=False) + "\n", "utf-8")
    yield {"phase": "judged", "decision": decision}


def _recipe(plan: Plan, folder: Path, parts: Parts) -> Any:
    """The recipe; its number of steps is measured once for a job, and then stays."""
    recipe = base_recipe(plan)
    if plan.steps:
        return recipe.changed(steps=plan.steps, warmup=max(1, plan.steps // 10))
    path = folder / "steps.json"
    if not path.exists():
        yield {"phase": "timing"}
        seconds = _pilot(plan, recipe)
        steps = max(1, int(USED * 60 * plan.minutes / seconds))
        own = (1 - plan.share) * recipe.batch if parts.rehearsed else recipe.batch
        steps = min(steps, math.ceil(EPOCHS * len(parts.learnt) / own))
        with replacing(path) as temporary:
            temporary.write_text(json.dumps({"steps": steps, "seconds": seconds}))
    steps = int(json.loads(path.read_text())["steps"])
    return recipe.changed(steps=steps, warmup=max(1, steps // 10))


def base_recipe(plan: Plan) -> Recipe:
    """How it is trained: as the preset of the base's name, or the balanced one, but gently."""
    base = Bundle.load(Path(plan.base))
    known = import_module(f"deepshade_trainer.presets.{plan.effect}").PRESETS
    name = base.name if base.name in known else "balanced"
    found = preset(name, plan.effect, base.network)
    return found.changed(
        lr=plan.lr or RATE,
        ema=EMA,
        batch=plan.batch or found.batch,
        seed=plan.seed,
        init_from=plan.base,
    )


def _pilot(plan: Plan, recipe: Recipe) -> float:
    """Seconds a step, by a few that nothing is kept of."""
    parts = own_parts(plan)
    times: list[float] = []
    with TemporaryDirectory() as scratch:
        short = recipe.changed(steps=PILOT, warmup=1)
        for progress in train(
            short,
            folders_of(plan),
            Run(Path(scratch)),
            split=lambda _: (parts.mixed(plan.share), []),
        ):
            if progress.step:
                times.append(time.monotonic())
    if len(times) < PILOT:
        raise KeyboardInterrupt  # asked to stop meanwhile
    return (times[-1] - times[0]) / (PILOT - 1)


def _blend(plan: Plan, recipe: Recipe, run: Run, parts: Parts, folder: Path) -> float:
    """Write the run `blended`: from the base as far to the tuned weights as the reminders allow.

    Weights between two that training connects are often better than both (Wortsman et al., Robust
    fine-tuning of zero-shot models, 2022). Without reminders the tests take their place.
    """
    tuned = run.load()[0]["average"]
    start = {**tuned, **bundle_weights(Bundle.load(Path(plan.base)))}
    start = {name: start[name] for name in tuned}
    if parts.reminders:
        data, numbers = dataset_of(plan), parts.reminders
    else:
        folders = [path for group in _tests(plan, folder).values() for path in group]
        data = Dataset(folders, plan.effect, per_channel=_shader(recipe, start).per_channel)
        numbers = list(range(len(data.entries)))
    before = _error(recipe, start, data, numbers)
    chosen = BLENDS[-1]
    for share in BLENDS:
        mixed = _between(start, tuned, share)
        if _error(recipe, mixed, data, numbers) <= before * (1 + MARGIN * plan.worse):
            chosen = share
            break
    weights = _between(start, tuned, chosen)
    blended = Run(folder / "blended")
    recipe.write(blended.recipe)
    blended.save({"average": weights}, recipe.steps, {"state": {}, "param_groups": []})
    return chosen


def _between(start: Tensors, end: Tensors, share: float) -> Tensors:
    return {
        name: torch.lerp(start[name], value, share) if value.is_floating_point() else value
        for name, value in end.items()
    }


def _shader(recipe: Recipe, weights: Tensors) -> Shader:
    network = build(recipe.network)
    network.load_state_dict(weights)
    return Shader(EFFECTS[recipe.effect], network).eval()


def _error(recipe: Recipe, weights: Tensors, data: Dataset, numbers: Sequence[int]) -> float:
    """Mean DSSIM of a network with these weights over samples."""
    shader = _shader(recipe, weights)
    found = [each.dssim for each in validated(shader, data, numbers, torch.device("cpu"))]
    return sum(found) / len(found)


def _export(plan: Plan, folder: Path) -> Bundle:
    """The bundle, measured on the tests, with its card."""
    base, blended = Bundle.load(Path(plan.base)), Run(folder / "blended")
    path = candidate(folder, plan)
    shutil.rmtree(path, ignore_errors=True)  # of a job that was killed while it wrote
    export(blended, path, folders_of(plan), radius=base.radius, fov=base.fov)
    tests = [each for group in _tests(plan, folder).values() for each in group]
    bundle = card.measure(Bundle.load(path), tests)
    own = ", ".join(sorted({str(entry.record["scene"]) for entry in _own(plan).entries})[:20])
    note = f"## Fine-tuned\n\nFrom `{base.name}` ({base.short_hash}) to views of {own}."
    card.write_card(bundle, blended, note)
    return bundle


def _judge(plan: Plan, bundle: Bundle, parts: Parts, folder: Path) -> Verdict:
    base = Bundle.load(Path(plan.base))
    own = _pair(base, bundle, folders_of(plan), parts.judges)
    if own is None or own.views < MIN_JUDGES:
        seen = own.views if own else 0
        raise DataError(
            f"only {seen} of the {len(parts.judges)} views that are kept to judge show enough",
            fix="give more views, or views that show more of the effect",
        )
    pairs = {name: _pair(base, bundle, each) for name, each in _tests(plan, folder).items()}
    tests = {name: pair for name, pair in pairs.items() if pair is not None}
    if not tests:
        raise _no_test(plan)
    return Verdict(own, tests, speed(base, bundle, plan.slower), plan.worse, plan.slower)


def _pair(
    base: Bundle, bundle: Bundle, folders: Sequence[Path], numbers: Sequence[int] | None = None
) -> Paired | None:
    """Both on the same views; None where none shows anything."""
    errors = []
    for each in (base, bundle):
        try:
            rows = list(evaluate(each, folders, numbers=numbers))
        except DataError:
            return None
        errors.append([row.figures["dssim"] for row in rows])
    noise = [row.figures["noise"] for row in rows if "noise" in row.figures]
    return Paired.of(errors[0], errors[1], noise)


def speed(base: Bundle, bundle: Bundle, allowed: float) -> float:
    """Time of the bundle's network over the base's, each as requests would run it, in turns.

    The shortest of each counts: whatever else runs only ever adds. Where that is over what is
    `allowed`, they are timed again, `TIMINGS` times in all.
    """
    tasks = {}
    for name, each in (("base", base), ("candidate", bundle)):
        engine = load_engine(each, choose(each), threads=torch.get_num_threads())
        sides = (up(side, each.size_multiple) for side in (bench.HEIGHT, bench.WIDTH))
        given = (black(each.environment),) if each.environment else ()
        tasks[name] = partial(engine.predict, bench.noise(each, *sides), *given)
    least = dict.fromkeys(tasks, math.inf)
    for _ in range(TIMINGS):
        times = alternate(tasks, Pace(0.0, min_rounds=ROUNDS))
        least = {name: min(least[name], *times[name]["ms"]) for name in tasks}
        if least["candidate"] <= allowed * least["base"]:
            break
    return least["candidate"] / least["base"]


def _tests(plan: Plan, folder: Path) -> dict[str, list[Path]]:
    """The test sets by name, or where there are none the shipped samples as one."""
    if plan.test:
        return {Path(each).name: [Path(each)] for each in plan.test}
    found = shipped.as_data(folder / "samples", plan.effect)
    if not found:
        raise _no_test(plan)
    return {"samples": found}


def _no_test(plan: Plan) -> DataError:
    return DataError(
        f"nothing shows whether {plan.effect} gets worse elsewhere",
        fix="give the trainer a library with test views: see docs/trainer.md",
    )


def _own(plan: Plan) -> Dataset:
    return Dataset([Path(each) for each in plan.data], plan.effect)


_PLACES = ("base", "data", "rehearsal", "test")
