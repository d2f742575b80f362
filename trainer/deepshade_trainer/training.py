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
from torch import Tensor, distributed, nn

from deepshade import judging, pictures
from deepshade.bundles import CONFIG, Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade_trainer import circles
from deepshade_trainer.dataset import Batch, Dataset, batches
from deepshade_trainer.losses import parse_loss
from deepshade_trainer.networks import Network, Shader, build, bundle_weights
from deepshade_trainer.networks.perceptron import PerceptronConfig
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.resident import Resident
from deepshade_trainer.run import Run
from deepshade_trainer.validation import answered, validated

VALIDATION_SAMPLES = 96
MAX_BAD_BATCHES = 100
_MOVED = 32  # pixels by which pictures are moved at most

# From a data set the numbers of samples to train on, where one may come several times, and of
# those to validate on.
Split = Callable[[Dataset], tuple[list[int], list[int]]]


@dataclass(frozen=True)
class Every:
    """After how many steps a run saves, and validates; neither changes what it learns."""

    save: int = 250
    validate: int = 500


@dataclass(frozen=True)
class Progress:
    """What a step reports: number, steps in all, smoothed loss, and figures if it validated."""

    step: int
    steps: int
    loss: float
    figures: dict[str, float] | None = None
    warning: str = ""


def train(
    recipe: Recipe,
    folders: Sequence[Path],
    run: Run,
    *,
    device: str = "cpu",
    split: Split | None = None,
    every: Every | None = None,
) -> Iterator[Progress]:
    """Train until `recipe.steps`; an existing `run` goes on where its checkpoint stands.

    Yields progress after every step. Batches with non-finite inputs, loss or gradients teach
    nothing: they are reported with the names of their samples and skipped. Without a `split` some
    scenes are held out, as the recipe says. In a process group of torch.distributed each process
    learns from its part of every batch, and the first alone writes and validates.

    Raises:
        ConfigError: the run was begun with another recipe, or there is no such device.
        DataError: there is too little data, or almost all of it is non-finite.
    """
    if isinstance(recipe.network, PerceptronConfig):
        with _finish_on_signals() as stopped:
            for step, loss, figures in circles.learn(recipe, folders, run, stopped):
                yield Progress(step, recipe.steps, loss, figures)
        return
    trainer = _Trainer(recipe, folders, run, device, split, every or Every())
    with _finish_on_signals() as stopped:
        yield from trainer.steps(stopped)


class _Trainer:
    def __init__(
        self,
        recipe: Recipe,
        folders: Sequence[Path],
        run: Run,
        device: str,
        split: Split | None,
        every: Every,
    ) -> None:
        if recipe.optimizer == "lbfgs":
            raise ConfigError("optimizer", detail="lbfgs needs all samples at once: perceptrons'")
        self.recipe, self.run, self.device = recipe, run, _device(device)
        self.every, self.rank, self.world = every, *_place()
        if recipe.batch % self.world:
            raise ConfigError(
                "batch", detail=f"{self.world} processes can't share a batch of {recipe.batch}"
            )
        torch.manual_seed(recipe.seed)
        self.network = build(recipe.network).to(self.device)
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.shader = Shader(EFFECTS[recipe.effect], self.network)
        runs = self.shader.per_channel
        self.data: Dataset
        if self.device.type == "cpu":
            self.data = Dataset(folders, recipe.effect, per_channel=runs)
        else:
            self.data = Resident(folders, recipe.effect, per_channel=runs, device=self.device)
        if split is None:
            self.training, held = self.data.split(recipe.val_fraction, seed=recipe.seed)
        else:
            self.training, held = split(self.data)
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
        if held and self.data.one_scene and split is None:
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
            _, sample = self.data.judged(number)
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
            if not self.rank:
                self.recipe.write(self.run.recipe)
            return 0
        begun = Recipe.read(self.run.recipe)
        if begun.changed(steps=self.recipe.steps) != self.recipe:
            raise ConfigError(
                "recipe",
                detail=f"{self.run.folder} was begun with another recipe; give the same one, or "
                "another --out",
            )
        if not self.rank:
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
        recipe, bad, smooth = self.recipe, 0, math.nan
        if self.first >= recipe.steps:
            return
        with self._log() as log:
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
                last = step == recipe.steps or self._any(stopped())
                if step % self.every.validate == 0 or step == recipe.steps:
                    figures = self._validate(log, step)
                if step % self.every.save == 0 or last:
                    self._save(step)
                yield Progress(step, recipe.steps, smooth, figures, self._warned())
                if last:
                    break

    def _log(self) -> Any:
        """TensorBoard's writer; for other processes than the first one that writes nothing."""
        if self.rank:
            return _NoLog()
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(self.run.log), purge_step=self.first)

    def _any(self, here: bool) -> bool:
        """Whether it is so in any process."""
        if self.world == 1:
            return here
        flag = torch.tensor(float(here))
        distributed.all_reduce(flag, distributed.ReduceOp.MAX)
        return bool(flag)

    def _warned(self) -> str:
        """The warnings since the last time."""
        warning = "; ".join(self.warnings)
        self.warnings.clear()
        return warning

    def _learn(self, batch: Batch) -> tuple[float, str]:
        """One step on a batch: its loss, and what was wrong if it taught nothing."""
        recipe = self.recipe
        gbuffer, reference = self._own(batch.gbuffer), self._own(batch.reference)
        finite = torch.isfinite(gbuffer).all() and torch.isfinite(reference).all()
        if self._any(not finite):
            return math.nan, "non-finite samples"
        self.shader.train()
        mixed = recipe.precision == "bf16"
        with torch.autocast(self.device.type, torch.bfloat16) if mixed else nullcontext():
            image = answered(self.shader, gbuffer)
        loss = self.loss(*self.shader.compared(image, reference))
        if recipe.steady:
            loss = (loss + self._moved(batch.step, gbuffer, reference, image)) / 2
        self.optimizer.zero_grad(set_to_none=True)
        if self._any(not torch.isfinite(loss)):
            return math.nan, f"loss {float(loss)}"
        loss.backward()  # type: ignore[no-untyped-call]
        self._share([loss.detach(), *(p.grad for p in self.network.parameters())])
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

    def _moved(self, step: int, gbuffer: Tensor, reference: Tensor, image: Tensor) -> Tensor:
        """The loss of the same pictures, moved by some pixels, and of what that changed."""
        recipe, most = self.recipe, min(_MOVED, *(side // 4 for side in gbuffer.shape[2:]))
        y, x = np.random.default_rng((recipe.seed, step)).integers(1, most + 1, 2).tolist()
        part, truth = gbuffer[:, :, y:, x:], reference[:, :, y:, x:]
        with torch.autocast(self.device.type, torch.bfloat16, recipe.precision == "bf16"):
            moved = answered(self.shader, part)
        # what the part doesn't show any more may rightly matter beside its edge
        inner = slice(most, None)
        change = moved[:, :, inner, inner] - image[:, :, y:, x:][:, :, inner, inner]
        return self.loss(*self.shader.compared(moved, truth)) + recipe.steady * change.abs().mean()

    def _own(self, whole: Tensor) -> Tensor:
        """This process's part of a batch, on the device."""
        return whole.chunk(self.world)[self.rank].to(self.device)

    def _share(self, tensors: Sequence[Tensor | None]) -> None:
        """Replace each by its mean over the processes; their parts of a batch are equally large."""
        for tensor in tensors if self.world > 1 else ():
            if tensor is not None:
                distributed.all_reduce(tensor)
                tensor /= self.world

    def _validate(self, log: Any, step: int) -> dict[str, float]:
        """Mean DSSIM and MAE of the averaged weights, beside the trivial answer's DSSIM."""
        if self.rank:
            return {}
        network = build(self.recipe.network).to(self.device)
        network.load_state_dict(self.average)
        shader = Shader(self.data.effect, network).eval()
        rows: list[list[float]] = []
        shown: list[Tensor] = []
        for found in validated(shader, self.data, self.held, self.device):
            rows.append([found.dssim, found.mae, found.trivial_dssim])
            if len(shown) < 6:
                shown.append(found.picture[0].expand(3, -1, -1))
        if not rows:
            return {}
        mean = np.mean(rows, axis=0)
        summary = dict(zip(("dssim", "mae", "trivial_dssim"), mean.tolist(), strict=True))
        summary["ratio"] = summary["dssim"] / summary["trivial_dssim"]
        for key, value in summary.items():
            log.add_scalar(f"validation/{key}", value, step)
        log.add_image("ours, reference, error", torch.cat(shown, 1).numpy(), step)
        preview = pictures.of_effect(torch.cat(shown[:2], 1), self.data.effect)
        pictures.save(self.run.preview, preview)
        history = json.loads(self.run.metrics.read_text()) if self.run.metrics.exists() else []
        history = [entry for entry in history if entry["step"] < step]
        with replacing(self.run.metrics) as temporary:
            temporary.write_text(
                json.dumps([*history, {"step": step, **summary}], indent=1, allow_nan=False)
            )
        return summary

    def _save(self, step: int) -> None:
        if self.rank:
            return
        groups = {"model": self.network.state_dict(), "average": self.average}
        self.run.save(groups, step, self.optimizer.state_dict())


class _NoLog:
    """What TensorBoard's writer is, but for nobody."""

    def __enter__(self) -> _NoLog:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def add_scalar(self, *_: object) -> None:
        """Write nothing."""


def _place() -> tuple[int, int]:
    """This process's number, and of how many, in torch's process group; (0, 1) without one."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return 0, 1
    return distributed.get_rank(), distributed.get_world_size()


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
