"""The training loop: resumable at any moment, deaf to non-finite batches."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade_trainer.dataset import Batch, Dataset, batches
from deepshade_trainer.losses import dssim, parse_loss
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

# Views whose reference varies less than this show nothing to judge (design, section 2).
MIN_CONTRAST = {"ao": 0.12}
SAVE_EVERY = 250
VALIDATE_EVERY = 500
VALIDATION_SAMPLES = 96
MAX_BAD_BATCHES = 100


@dataclass(frozen=True)
class Progress:
    """What a step reports: number, steps in all, smoothed loss, and figures if it validated."""

    step: int
    steps: int
    loss: float
    figures: dict[str, float] | None = None
    warning: str = ""


def train(
    recipe: Recipe, folders: Sequence[Path], run: Run, *, device: str = "cpu"
) -> Iterator[Progress]:
    """Train until `recipe.steps`; an existing `run` goes on where its checkpoint stands.

    Yields progress after every step. Batches with non-finite inputs, loss or gradients teach
    nothing: they are reported with the names of their samples and skipped.

    Raises:
        ConfigError: the run was begun with another recipe.
        DataError: there is too little data, or almost all of it is non-finite.
    """
    trainer = _Trainer(recipe, folders, run, device)
    with _finish_on_signals() as stopped:
        yield from trainer.steps(stopped)


class _Trainer:
    def __init__(self, recipe: Recipe, folders: Sequence[Path], run: Run, device: str) -> None:
        self.recipe, self.run, self.device = recipe, run, torch.device(device)
        self.data = Dataset(folders, recipe.effect)
        self.training, held = self.data.split(recipe.held_out, seed=recipe.seed)
        if len(self.training) < recipe.batch:
            raise DataError(
                f"{len(self.training)} samples don't fill a batch of {recipe.batch}",
                fix="render more views, or train with a smaller --set batch=",
            )
        self.warnings: list[str] = []
        self.held = self._telling(held)
        torch.manual_seed(recipe.seed)
        background = EFFECTS[recipe.effect].background
        self.model = build(recipe.network, background).to(self.device)
        self.model = self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        self.optimizer = _optimizer(recipe, self.model)
        self.loss = parse_loss(recipe.loss)
        self.first = self._resume()

    def _telling(self, held: list[int]) -> list[int]:
        """Up to `VALIDATION_SAMPLES` sound held-out samples that have something to show."""
        least = MIN_CONTRAST.get(self.recipe.effect, 0.0)
        step = max(1, len(held) // (2 * VALIDATION_SAMPLES))
        found = []
        for number in held[::step]:
            sample = self.data.load(number)
            if not all(np.isfinite(plane).all() for plane in sample.values()):
                self.warnings.append(f"not validated on: {self.data.entries[number].name}")
            elif float(sample[self.data.reference].std()) >= least:
                found.append(number)
        if not found and self.recipe.held_out:
            self.warnings.append(
                f"nothing to validate on: none of {len(held)} held-out samples is sound and has "
                f"a contrast of {least}"
            )
        return found[:VALIDATION_SAMPLES]

    def _resume(self) -> int:
        if not self.run.checkpoint.exists():
            if self.recipe.start:
                self._begin_with(Run(Path(self.recipe.start)))
            self.recipe.write(self.run.recipe)
            return 0
        begun = Recipe.read(self.run.recipe)
        if begun.changed(steps=self.recipe.steps) != self.recipe:
            raise ConfigError(
                "recipe",
                detail=f"{self.run.folder} was begun with another recipe; give the same one, or "
                "another --out",
            )
        self.recipe.write(self.run.recipe)  # the number of steps may be another
        groups, step, optimizer = self.run.load()
        self.model.load_state_dict(groups["model"])
        self.average = {k: v.to(self.device) for k, v in groups["average"].items()}
        self.optimizer.load_state_dict(optimizer)
        return step

    def _begin_with(self, other: Run) -> None:
        """Take another run's averaged weights, where it has such; the rest stays random."""
        if not other.checkpoint.is_file():
            raise ConfigError("start", detail=f"there is no run to start from in {other.folder}")
        groups, _, _ = other.load()
        own = self.model.state_dict()
        known = {
            name: weight
            for name, weight in groups.get("average", {}).items()
            if name in own and own[name].shape == weight.shape
        }
        if not known:
            raise ConfigError(
                "start", detail=f"{other.folder} is of another network: no weights in common"
            )
        self.model.load_state_dict({**own, **known})
        self.average = {k: v.detach().clone() for k, v in self.model.state_dict().items()}
        if fresh := sorted(own.keys() - known.keys()):
            self.warnings.append(f"not in {other.folder}, so begun at random: {', '.join(fresh)}")

    def steps(self, stopped: Callable[[], bool]) -> Iterator[Progress]:
        from torch.utils.tensorboard import SummaryWriter

        recipe, bad, smooth = self.recipe, 0, math.nan
        if self.first >= recipe.steps:
            return
        with SummaryWriter(str(self.run.log), purge_step=self.first) as log:
            source = batches(
                self.data,
                self.training,
                recipe.batch,
                seed=recipe.seed,
                first=self.first,
                last=recipe.steps,
            )
            for batch in source:
                step = batch.step + 1
                value, problem = self._learn(batch)
                figures = None
                if problem:
                    bad += 1
                    names = ", ".join(self.data.entries[n].name for n in batch.numbers)
                    self.warnings.append(f"step {step}: {problem}; skipped {names}")
                    if bad >= MAX_BAD_BATCHES:
                        raise DataError(
                            f"{bad} useless batches in a row, the last at {self.warnings[-1]}"
                        )
                else:
                    bad = 0
                    smooth = value if math.isnan(smooth) else 0.98 * smooth + 0.02 * value
                    log.add_scalar("loss/train", value, step)
                last = step == recipe.steps or stopped()
                if step % VALIDATE_EVERY == 0 or step == recipe.steps:
                    figures = self._validate(log, step)
                if step % SAVE_EVERY == 0 or last:
                    self._save(step)
                warning = "; ".join(self.warnings)
                self.warnings.clear()
                yield Progress(step, recipe.steps, smooth, figures, warning)
                if last:
                    break

    def _learn(self, batch: Batch) -> tuple[float, str]:
        """One step on a batch: its loss, and what was wrong if it taught nothing."""
        recipe = self.recipe
        gbuffer, reference = batch.gbuffer.to(self.device), batch.reference.to(self.device)
        if not (torch.isfinite(gbuffer).all() and torch.isfinite(reference).all()):
            return math.nan, "non-finite samples"
        self.model.train()
        mixed = recipe.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16) if mixed else nullcontext():
            image = self.model(gbuffer)
        loss = self.loss(image, reference)
        self.optimizer.zero_grad(set_to_none=True)
        if not torch.isfinite(loss):
            return math.nan, f"loss {float(loss)}"
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), recipe.clip or math.inf)
        if not torch.isfinite(norm):
            return math.nan, f"gradient norm {float(norm)}"
        rate = recipe.rate * _schedule(recipe, batch.step)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        # A young average follows closely, or it would remember the random start.
        decay = min(recipe.ema, (1 + batch.step) / (10 + batch.step)) if recipe.ema else 0.0
        with torch.no_grad():
            for name, value in self.model.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        return float(loss.detach()), ""

    def _validate(self, log: Any, step: int) -> dict[str, float]:
        """Mean DSSIM and MAE of the averaged weights, beside the trivial answer's DSSIM."""
        model = build(self.recipe.network, EFFECTS[self.recipe.effect].background)
        model.load_state_dict({k: v.cpu() for k, v in self.average.items()})
        model = model.to(self.device).eval()
        trivial = EFFECTS[self.recipe.effect].background
        rows: list[list[float]] = []
        pictures: list[Tensor] = []
        with torch.inference_mode():
            for number in self.held:
                gbuffer, reference = self.data.batch([number])
                image = model(gbuffer.to(self.device)).cpu()
                blank = torch.full_like(reference, trivial)
                rows.append(
                    [
                        float(dssim(image, reference)),
                        float((image - reference).abs().mean()),
                        float(dssim(blank, reference)),
                    ]
                )
                if len(pictures) < 6:
                    pictures.append(_side_by_side(gbuffer, image, reference))
        if not rows:
            return {}
        mean = np.mean(rows, axis=0)
        figures = {
            "dssim": float(mean[0]),
            "mae": float(mean[1]),
            "trivial_dssim": float(mean[2]),
            "ratio": float(mean[0] / mean[2]),
        }
        for key, value in figures.items():
            log.add_scalar(f"validation/{key}", value, step)
        log.add_image("normal, ours, reference, error", torch.cat(pictures, 1).numpy(), step)
        history = json.loads(self.run.metrics.read_text()) if self.run.metrics.exists() else []
        history = [entry for entry in history if entry["step"] < step]
        with replacing(self.run.metrics) as temporary:
            temporary.write_text(
                json.dumps([*history, {"step": step, **figures}], indent=1, allow_nan=False)
            )
        return figures

    def _save(self, step: int) -> None:
        groups = {"model": self.model.state_dict(), "average": self.average}
        self.run.save(groups, step, self.optimizer.state_dict())


def _side_by_side(gbuffer: Tensor, image: Tensor, reference: Tensor) -> Tensor:
    """(3, H, 4 W): normals, our image, the reference, their difference."""
    normal = gbuffer[0, :3] * 0.5 + 0.5
    grey = [image[0], reference[0], (image[0] - reference[0]).abs()]
    return torch.cat([normal, *(g.expand(3, -1, -1) for g in grey)], 2).clamp(0, 1)


def _optimizer(recipe: Recipe, model: Shader) -> torch.optim.Optimizer:
    if recipe.optimizer == "adamw":
        return torch.optim.AdamW(
            model.parameters(), recipe.rate, betas=(0.9, 0.99), weight_decay=recipe.decay
        )
    if recipe.optimizer == "adadelta":
        # The paper's "momentum 0.9" is ADADELTA's decay of its running averages.
        return torch.optim.Adadelta(
            model.parameters(), recipe.rate, rho=0.9, weight_decay=recipe.decay
        )
    raise ConfigError(recipe.optimizer, ("adamw", "adadelta"))


def _schedule(recipe: Recipe, step: int) -> float:
    """The learning rate's factor at `step`: linear warm-up, then constant or half a cosine."""
    if step < recipe.warmup:
        return (step + 1) / recipe.warmup
    if recipe.schedule == "constant":
        return 1.0
    done = (step - recipe.warmup) / max(1, recipe.steps - recipe.warmup)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


@contextmanager
def _finish_on_signals() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a request to save and stop after the current step."""
    asked = False

    def ask(*_: object) -> None:
        nonlocal asked
        if asked:  # the second time means now
            raise KeyboardInterrupt
        asked = True

    previous = {s: signal.signal(s, ask) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
