"""Training for a study: the trainer's own loop, with errors on all three splits along the way."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from deepshade import judging
from deepshade.effects import EFFECTS
from deepshade.files import replacing
from deepshade.timing import significant
from deepshade_report.studies.common.bench import Bench
from deepshade_trainer.dataset import Dataset, spread
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.recipe import Recipe, preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import Every, train
from deepshade_trainer.validation import validated

_TRAIN_SAMPLES = 24  # of those that are trained on, to measure on


def recipe(
    bench: Bench,
    effect: str = "ao",
    *,
    network: dict[str, Any] | None = None,
    loss: str = "dssim",
    steps: int | None = None,
    seed: int = 0,
) -> Recipe:
    """The paper's network of an effect, changed by `network`, with our optimizer.

    ADADELTA needs the paper's hundreds of thousands of steps; AdamW shows a shape in hundreds.
    """
    count = steps or bench.scale.steps
    ours = Recipe()
    return preset("paper", effect).changed(
        network=dict(network or {}),
        loss=loss,
        steps=count,
        seed=seed,
        batch=bench.scale.batch,
        warmup=count // 10,
        precision="fp32",
        **{
            name: getattr(ours, name)
            for name in ("optimizer", "lr", "weight_decay", "schedule", "clip", "ema")
        },
    )


def trained(
    bench: Bench,
    made: Recipe,
    name: str,
    *,
    sets: tuple[str, str] = ("learn", "held"),
    keep: Callable[[Dataset, Sequence[int]], Sequence[int]] | None = None,
) -> dict[str, Any]:
    """A curve of errors on the training, validation and test split, and the last of them.

    `name` is the run's folder: one that was stopped goes on. Of the samples of the first set those
    that `keep` chooses are learnt from. Raises KeyboardInterrupt where Ctrl-C stopped it.
    """
    folders = [bench.set(each) for each in sets]
    folder, scale = bench.runs(name), bench.scale
    torch.set_num_threads(bench.threads)
    network = build(made.network)
    shader = Shader(EFFECTS[made.effect], network)
    data = Dataset(folders, made.effect, per_channel=shader.per_channel)
    own = [k for k, entry in enumerate(data.entries) if entry.path.parent == folders[0]]
    held = [k for k, entry in enumerate(data.entries) if entry.path.parent == folders[1]]
    learning = list(keep(data, own)) if keep else own
    third = len(held) * scale.val_views // (scale.val_views + scale.test_views)
    splits = {
        "train": [learning[k] for k in spread(len(learning), _TRAIN_SAMPLES)],
        "validation": held[:third],
        "test": held[third:],
    }
    splits = {split: shown(data, numbers) for split, numbers in splits.items()}
    often = max(1, made.steps // scale.curve)
    every, run, notes = Every(often, made.steps + 1), Run(folder), folder / "curve.json"

    def look(step: int) -> None:
        """Note the errors of the checkpoint of `step`, if it is one of the curve's."""
        if (step % often and step != made.steps) or step in {e["step"] for e in _noted(notes)}:
            return
        shader.network.load_state_dict(run.load()[0]["average"])
        errors = {s: errors_of(shader.eval(), data, n) for s, n in splits.items()}
        with replacing(notes) as temporary:
            temporary.write_text(json.dumps([*_noted(notes), {"step": step, **errors}]), "utf-8")

    if run.checkpoint.is_file():  # stopped, maybe before its errors were noted
        look(run.load()[1])
    held_out = splits["validation"][:2]  # the trainer looks at them once, at the end
    for progress in train(made, folders, run, split=lambda _: (learning, held_out), every=every):
        bench.doing(f"{name}: step {progress.step} of {made.steps}, loss {progress.loss:.4f}")
        look(progress.step)
    if run.load()[1] < made.steps:
        raise KeyboardInterrupt
    curve = _noted(notes)
    last = curve[-1]
    return {
        "parameters": sum(p.numel() for p in network.parameters()),
        "views": {"train": len(learning), **{s: len(n) for s, n in splits.items() if s != "train"}},
        **{split: last[split] for split in splits},
        "curve": curve,
    }


def shown(data: Dataset, numbers: Sequence[int]) -> list[int]:
    """Those samples that show something by the effect's measure; all of them if none does."""
    found = []
    for number in numbers:
        _, sample = data.judged(number)
        seen = judging.contrast(data.effect, sample[data.reference], sample["trivial"])
        found += [number] if seen >= data.effect.min_contrast else []
    return found or list(numbers)


def errors_of(shader: Shader, data: Dataset, numbers: Sequence[int]) -> dict[str, float]:
    """Means over samples: DSSIM, MAE, RMSE, and the trivial answer's DSSIM."""
    rows = []
    for found in validated(shader, data, numbers, torch.device("cpu")):
        error = found.picture.chunk(3, 3)[2]
        rmse = float(error.square().mean().sqrt())
        rows.append((found.dssim, found.mae, rmse, found.trivial_dssim))
    names = ("dssim", "mae", "rmse", "trivial")
    means = [significant(fmean(each)) for each in zip(*rows, strict=True)]
    return dict(zip(names, means, strict=True))


def _noted(path: Path) -> list[dict[str, Any]]:
    return list(json.loads(path.read_text("utf-8"))) if path.is_file() else []
