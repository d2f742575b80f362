"""How a mesh's perceptron is trained: all samples at once, for minutes of one core at most.

Half of the views are learnt from, a quarter says when to stop, and the last quarter is the test.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from deepshade.circles import POINTS
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.losses import parse_loss
from deepshade_trainer.networks import build
from deepshade_trainer.networks.perceptron import Perceptron
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

ITERATIONS = 10  # of L-BFGS in a step
HISTORY = 50
PATIENCE = 12  # steps without a better validation
_SHARES = (0.5, 0.25)  # of views: training, validation; the rest is the test

Part = tuple[Tensor, Tensor]  # normals (1, 48, 1, n) and answers (1, outputs, 1, n)


def parts(folders: Sequence[Path], recipe: Recipe) -> list[Part]:
    """The samples to train on, to validate on and to test on: whole views each.

    Raises DataError: there are under four views, or the data isn't of circles.
    """
    data = Dataset(folders, recipe.effect, inputs=Perceptron.attributes)
    order = np.random.default_rng(recipe.seed).permutation(len(data.entries))
    ends = [round(share * len(order)) for share in np.cumsum(_SHARES)]
    if len(order) < 4:
        raise DataError(f"{len(order)} views are too few", fix="render more: --views 128")
    return [_part(data, numbers.tolist()) for numbers in np.split(order, ends)]


def _part(data: Dataset, numbers: Sequence[int]) -> Part:
    normals, answers = [], []
    for number in numbers:
        sample = data.load(number)
        around, answer = sample[Perceptron.attributes[0]], sample[data.reference]
        if around.shape[1] != POINTS or answer.shape[1] != 1:
            raise DataError(
                f"{data.entries[number].path.parent} holds pictures, and a perceptron learns from "
                "pixels with the normals around each",
                fix="render it with --pixels 512",
            )
        # point by point, x y z of each: as the network joins what it gathers
        normals.append(around.swapaxes(0, 1).reshape(3 * POINTS, 1, -1))
        answers.append(answer)
    x, y = (torch.from_numpy(np.concatenate(each, 2))[None] for each in (normals, answers))
    if not (torch.isfinite(x).all() and torch.isfinite(y).all()):
        raise DataError("some samples aren't finite", fix="render the data again")
    return x, y


def learn(
    recipe: Recipe, folders: Sequence[Path], run: Run, stopped: Callable[[], bool]
) -> Iterator[tuple[int, float, dict[str, float]]]:
    """(step, loss, figures of the validation) after each step, up to `recipe.steps`.

    The run's average is what validated best. After `PATIENCE` steps without a better one the last
    step is taken for done. A run that was stopped goes on from its best weights.

    Raises:
        ConfigError: the run was begun with another recipe.
        DataError: see `parts`.
    """
    torch.manual_seed(recipe.seed)
    training, validation, test = parts(folders, recipe)
    network = build(recipe.network)
    assert isinstance(network, Perceptron)
    first = _resume(recipe, run, network)
    if first >= recipe.steps:
        return
    loss = parse_loss(recipe.loss)
    optimizer = _optimizer(recipe, network)
    blank = {f"trivial_{name}": v for name, v in _figures(training[1].mean(), validation).items()}
    best, kept, since, step = math.inf, copy.deepcopy(network.state_dict()), 0, first
    while step < recipe.steps:
        step += 1

        def closure() -> float:
            optimizer.zero_grad()
            found = loss(network.answered(training[0]), training[1])
            found.backward()  # type: ignore[no-untyped-call]
            return float(found.detach())

        value = optimizer.step(closure)
        with torch.inference_mode():
            figures = _figures(network.answered(validation[0]), validation)
        since += 1
        if figures["rmse"] < best:
            best, kept, since = figures["rmse"], copy.deepcopy(network.state_dict()), 0
        if ended := since >= PATIENCE or not math.isfinite(value):
            step = recipe.steps
        if ended or step == recipe.steps or stopped():
            network.load_state_dict(kept)
            with torch.inference_mode():
                tested = _figures(network.answered(test[0]), test)
            figures = _figures(network.answered(validation[0]).detach(), validation) | blank
            figures |= {f"test_{name}": found for name, found in tested.items()}
            run.save(
                {"model": network.state_dict(), "average": kept},
                step,
                {"state": {}, "param_groups": []},
            )
            with replacing(run.metrics) as part:
                part.write_text(json.dumps([{"step": step, **figures}], indent=1))
            yield step, value, figures
            return
        yield step, value, {}


def _resume(recipe: Recipe, run: Run, network: Perceptron) -> int:
    if not run.checkpoint.exists():
        recipe.write(run.recipe)
        return 0
    if Recipe.read(run.recipe).changed(steps=recipe.steps) != recipe:
        raise ConfigError(
            "recipe",
            detail=f"{run.folder} was begun with another recipe; give the same one, or "
            "another --out",
        )
    recipe.write(run.recipe)
    groups, step, _ = run.load()
    network.load_state_dict(groups["model"])
    return step


def _optimizer(recipe: Recipe, network: Perceptron) -> torch.optim.Optimizer:
    weights = network.parameters()
    if recipe.optimizer == "lbfgs":
        return torch.optim.LBFGS(
            weights, 1.0, ITERATIONS, history_size=HISTORY, line_search_fn="strong_wolfe"
        )
    return torch.optim.AdamW(weights, recipe.lr, weight_decay=recipe.weight_decay)


def _figures(answer: Tensor, part: Part) -> dict[str, float]:
    """Errors of answers as they are served: within 0 and 1."""
    apart = answer.clamp(0, 1) - part[1]
    return {"mae": float(apart.abs().mean()), "rmse": float(apart.square().mean().sqrt())}
