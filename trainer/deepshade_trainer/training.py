"""The training loop: resumable at any moment, deaf to non-finite batches."""

from __future__ import annotations

import json
import math
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deepshade import judging
from deepshade.bundles import CONFIG, Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade_trainer.dataset import Batch, Dataset, batches
from deepshade_trainer.lit import Lit
from deepshade_trainer.losses import dssim, parse_loss
from deepshade_trainer.networks import Network, Shader, build, bundle_weights
from deepshade_trainer.networks.openings import Openings
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.resident import Resident
from deepshade_trainer.run import Run

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
        ConfigError: the run was begun with another recipe, or there is no such device.
        DataError: there is too little data, or almost all of it is non-finite.
    """
    trainer = _Trainer(recipe, folders, run, device)
    with _finish_on_signals() as stopped:
        yield from trainer.steps(stopped)


class _Trainer:
    def __init__(self, recipe: Recipe, folders: Sequence[Path], run: Run, device: str) -> None:
        self.recipe, self.run, self.device = recipe, run, _device(device)
        torch.manual_seed(recipe.seed)
        self.network = build(recipe.network).to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.shader = Shader(EFFECTS[recipe.effect], self.network)
        runs = self.shader.per_channel
        self.data: Dataset
        if isinstance(self.network, Openings):
            self.data = Lit(folders, recipe.effect)
        elif self.device.type == "cpu":
            self.data = Dataset(folders, recipe.effect, per_channel=runs)
        else:
            self.data = Resident(folders, recipe.effect, per_channel=runs, device=self.device)
        self.training, held = self.data.split(recipe.val_fraction, seed=recipe.seed)
        if len(self.training) < recipe.batch:
            raise DataError(
                f"{len(self.training)} samples don't fill a batch of {recipe.batch}",
                fix="render more views, or train with a smaller --set batch=",
            )
        self.warnings: list[str] = []
        if recipe.schedule_is_cut:
            self.warnings.append(
                f"the warm-up of {recipe.warmup} steps is longer than the run of {recipe.steps}: "
                f"the rate never reaches {recipe.lr:g}; --set warmup={recipe.steps // 10} would do"
            )
        if held and self.data.one_scene:
            self.warnings.append(
                f"one scene: {len(held)} of its {len(self.data.entries)} views are held out, so "
                "figures are of new views of this scene, not of new scenes"
            )
        self.held = self._judged(held)
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.optimizer = _optimizer(recipe, self.network)
        self.loss = parse_loss(recipe.loss)
        self.first = self._resume()

    def _judged(self, held: list[int]) -> list[int]:
        """Up to `VALIDATION_SAMPLES` sound held-out samples that have something to show."""
        effect = self.data.effect
        step = max(1, len(held) // (2 * VALIDATION_SAMPLES))
        found = []
        for number in held[::step]:
            _, _, sample = self.data.judged(number)
            if not all(np.isfinite(plane).all() for plane in sample.values()):
                self.warnings.append(f"not validated on: {self.data.entries[number].name}")
                continue
            shown = judging.contrast(effect, sample[self.data.reference], sample["trivial"])
            if shown >= effect.min_contrast:
                found.append(number)
        if not found and self.recipe.val_fraction:
            self.warnings.append(
                f"nothing to validate on: none of {len(held)} held-out samples is sound and has "
                f"a contrast of {effect.min_contrast}"
            )
        return found[:VALIDATION_SAMPLES]

    def _resume(self) -> int:
        if not self.run.checkpoint.exists():
            if self.recipe.init_from:
                self._begin_with(Path(self.recipe.init_from))
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
        self.network.load_state_dict(groups["model"])
        self.average = {k: v.to(self.device) for k, v in groups["average"].items()}
        self.optimizer.load_state_dict(optimizer)
        return step

    def _begin_with(self, folder: Path) -> None:
        """Take the weights of a bundle or a run's average, where known; the rest stays random."""
        if (folder / CONFIG).is_file():
            weights = bundle_weights(Bundle.load(folder))
        elif Run(folder).checkpoint.is_file():
            weights = Run(folder).load()[0].get("average", {})
        else:
            raise ConfigError("init_from", detail=f"{folder} is no run to start from, nor a bundle")
        own = self.network.state_dict()
        # a network may have as a part of it what another is
        weights = {f"trunk.{k}": w for k, w in weights.items()} | weights
        known = {k: w for k, w in weights.items() if k in own and own[k].shape == w.shape}
        if not known:
            raise ConfigError(
                "init_from", detail=f"{folder} is of another network: no weights in common"
            )
        self.network.load_state_dict({**own, **known})
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        if fresh := sorted(own.keys() - known.keys()):
            self.warnings.append(f"not in {folder}, so begun at random: {', '.join(fresh)}")

    def steps(self, stopped: Callable[[], bool]) -> Iterator[Progress]:
        from torch.utils.tensorboard import SummaryWriter

        recipe, bad, smooth = self.recipe, 0, math.nan
        if self.first >= recipe.steps:
            return
        with SummaryWriter(str(self.run.log), purge_step=self.first) as log:
            if recipe.init_from and not self.first:  # what it has to beat
                yield Progress(0, recipe.steps, math.nan, self._validate(log, 0), self._warned())
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
                yield Progress(step, recipe.steps, smooth, figures, self._warned())
                if last:
                    break

    def _warned(self) -> str:
        """The warnings since the last time."""
        warning = "; ".join(self.warnings)
        self.warnings.clear()
        return warning

    def _learn(self, batch: Batch) -> tuple[float, str]:
        """One step on a batch: its loss, and what was wrong if it taught nothing."""
        recipe = self.recipe
        gbuffer, reference = batch.gbuffer.to(self.device), batch.reference.to(self.device)
        if not (torch.isfinite(gbuffer).all() and torch.isfinite(reference).all()):
            return math.nan, "non-finite samples"
        self.shader.train()
        mixed = recipe.precision == "bf16"
        given = [each.to(self.device) for each in batch.light]
        with torch.autocast(self.device.type, torch.bfloat16) if mixed else nullcontext():
            image = self._answered(self.shader, gbuffer, given)
        loss = self.loss(*self.shader.compared(image, reference))
        self.optimizer.zero_grad(set_to_none=True)
        if not torch.isfinite(loss):
            return math.nan, f"loss {float(loss)}"
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip or math.inf)
        if not torch.isfinite(norm):
            return math.nan, f"gradient norm {float(norm)}"
        lr = recipe.lr * _schedule(recipe, batch.step)
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        self.optimizer.step()
        # A young average follows closely, or it would remember the random start.
        decay = min(recipe.ema, (1 + batch.step) / (10 + batch.step)) if recipe.ema else 0.0
        with torch.no_grad():
            for name, value in self.network.state_dict().items():
                self.average[name].lerp_(value, 1 - decay)
        return float(loss.detach()), ""

    @staticmethod
    def _answered(shader: Shader, gbuffer: Tensor, given: Sequence[Tensor]) -> Tensor:
        """The answer on the transfer curve, as large as the G-buffer."""
        height, width = gbuffer.shape[2:]
        padded = shader.padded(gbuffer)
        image = shader.lit(padded, *given) if given else shader.on_curve(padded)
        return image[:, :, :height, :width]

    def _validate(self, log: Any, step: int) -> dict[str, float]:
        """Mean DSSIM and MAE of the averaged weights, beside the trivial answer's DSSIM."""
        effect = self.data.effect
        network = build(self.recipe.network).to(self.device)
        network.load_state_dict(self.average)
        shader = Shader(effect, network).eval()
        rows: list[list[float]] = []
        pictures: list[Tensor] = []
        for number in self.held:
            gbuffer, light, sample = self.data.judged(number)
            given = [each.to(self.device) for each in light]
            with torch.inference_mode():
                found = shader.bounded(self._answered(shader, gbuffer.to(self.device), given))
            answer = found.cpu().flatten(0, 1).numpy()
            reference, blank = sample[self.data.reference], sample["trivial"]
            image, truth, nothing = (
                torch.from_numpy(each)[None]
                for each in judging.exposed(effect, reference, answer, reference, blank)
            )
            error = (image - truth).abs()
            figures = dssim(image, truth), error.mean(), dssim(nothing, truth)
            rows.append([float(figure) for figure in figures])
            if len(pictures) < 6:
                pictures.append(torch.cat([image, truth, error], 3)[0].expand(3, -1, -1))
        if not rows:
            return {}
        mean = np.mean(rows, axis=0)
        summary = dict(zip(("dssim", "mae", "trivial_dssim"), mean.tolist(), strict=True))
        summary["ratio"] = summary["dssim"] / summary["trivial_dssim"]
        for key, value in summary.items():
            log.add_scalar(f"validation/{key}", value, step)
        log.add_image("ours, reference, error", torch.cat(pictures, 1).numpy(), step)
        history = json.loads(self.run.metrics.read_text()) if self.run.metrics.exists() else []
        history = [entry for entry in history if entry["step"] < step]
        with replacing(self.run.metrics) as temporary:
            temporary.write_text(
                json.dumps([*history, {"step": step, **summary}], indent=1, allow_nan=False)
            )
        return summary

    def _save(self, step: int) -> None:
        groups = {"model": self.network.state_dict(), "average": self.average}
        self.run.save(groups, step, self.optimizer.state_dict())


def _device(name: str) -> torch.device:
    """The device of that name. Raises ConfigError where this machine or PyTorch lacks it."""
    kind, _, number = name.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdecimal()):
        raise ConfigError(name, detail=f"no device is called {name!r}: cpu, cuda or cuda:1")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        built = torch.version.cuda
        raise ConfigError(
            "device",
            detail=f"PyTorch finds no device '{name}': "
            + (
                "look whether 'nvidia-smi' lists it"
                if built
                else "this build is for the CPU alone; install PyTorch's CUDA build"
            )
            + ", or leave --device out to train on the CPU",
        )
    return torch.device(name)


def _optimizer(recipe: Recipe, network: Network) -> torch.optim.Optimizer:
    weights, lr, decay = network.parameters(), recipe.lr, recipe.weight_decay
    if recipe.optimizer == "adadelta":
        # The paper's "momentum 0.9" is ADADELTA's decay of its running averages.
        return torch.optim.Adadelta(weights, lr, rho=0.9, weight_decay=decay)
    return torch.optim.AdamW(weights, lr, betas=(0.9, 0.99), weight_decay=decay)


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
    """Turn Ctrl-C and SIGTERM into a request to save and stop after the current step.

    Only the main thread hears signals: elsewhere nothing is asked for.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
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
