"""Writes a bundle from a trained network, and proves that ONNX Runtime computes the same."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import MODEL, WEIGHTS, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.errors import DataError
from deepshade.files import replacing

from .dataset import Dataset
from .networks import Shader, build
from .recipe import Recipe
from .run import Run

INPUT, OUTPUT = "gbuffer", "shade"
OPSET = 18
# How far ONNX Runtime may stray from torch, both in float32, on values in [0, 1].
TOLERANCE = 1e-4
PARITY_SAMPLES = 8


def load_shader(run: Run) -> tuple[Recipe, Shader]:
    """A run's recipe and its network with averaged weights, in evaluation mode.

    Raises:
        DataError: the run has no checkpoint.
    """
    if not run.checkpoint.exists():
        raise DataError(f"{run.folder} holds no checkpoint", fix="train first: deepshade train")
    recipe = Recipe.read(run.recipe)
    model = build(recipe.network, EFFECTS[recipe.effect].background)
    groups, _, _ = run.load()
    model.load_state_dict(groups["average"])
    return recipe, model.eval()


def export(
    run: Run,
    folder: Path,
    data: Sequence[Path],
    *,
    radius: float = 1.0,
    fov: float = 50.0,
    metrics: dict[str, Any] | None = None,
) -> tuple[Bundle, float]:
    """Write the bundle `folder` (its last two names are effect and name) from `run`.

    Returns it and the largest difference between ONNX Runtime and torch over real G-buffers of
    `data`. `radius` is the effect radius, in scene units, of requests that name none.

    Raises:
        DataError: the difference exceeds `TOLERANCE`; no configuration is then written.
    """
    recipe, model = load_shader(run)
    effect = EFFECTS[recipe.effect]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").unlink(missing_ok=True)  # no bundle while its files change
    write_onnx(model, folder / MODEL)
    with replacing(folder / WEIGHTS) as temporary:
        tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
        temporary.write_bytes(save(tensors))
    samples = Dataset(data, recipe.effect)
    chosen = np.linspace(0, len(samples.entries) - 1, PARITY_SAMPLES).astype(int)
    gbuffers = [samples.batch([int(number)])[0] for number in chosen]
    worst = parity(model, folder / MODEL, gbuffers)
    if not worst <= TOLERANCE:
        raise DataError(f"ONNX Runtime differs from torch by {worst:.2e}, over {TOLERANCE:.0e}")
    planes = torch.cat(gbuffers)
    ranges, start = {}, 0
    for name in effect.inputs:
        count = len(ATTRIBUTES[name].channels)
        block = planes[:, start : start + count]
        ranges[name] = (float(block.min()), float(block.max()))
        start += count
    bundle = write_config(
        folder,
        effect=recipe.effect,
        name=folder.name,
        inputs=effect.inputs,
        outputs=effect.outputs,
        radius=radius,
        fov=fov,
        size_multiple=model.size_multiple,
        halo=model.halo,
        ranges=ranges,
        metrics={**(metrics or {}), "parity": {"onnxruntime_vs_torch_max": worst}},
        input_name=INPUT,
        output_name=OUTPUT,
    )
    return bundle, worst


def write_onnx(model: Shader, path: Path) -> None:
    """Export `model` with a free batch, height and width, and its weights inside the file."""
    import onnx

    side = 2 * model.size_multiple
    example = torch.zeros(1, model.config.inputs, side, side)
    free = {0: "batch", 2: "height", 3: "width"}
    with replacing(path) as temporary:
        with _quiet(), torch.inference_mode():
            torch.onnx.export(
                model,
                (example,),
                str(temporary),
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_axes={INPUT: free, OUTPUT: free},
                opset_version=OPSET,
                dynamo=False,
            )
        graph = onnx.load(str(temporary))
        onnx.checker.check_model(graph, full_check=True)


def parity(model: Shader, path: Path, gbuffers: Sequence[Tensor]) -> float:
    """Largest absolute difference between ONNX Runtime (CPU, fp32) and torch."""
    import onnxruntime as ort

    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = 0.0
    with torch.inference_mode():
        for gbuffer in gbuffers:
            ours: NDArray[np.float32] = session.run(None, {INPUT: gbuffer.numpy()})[0]
            worst = max(worst, float(np.abs(ours - model(gbuffer).numpy()).max()))
    return worst


@contextmanager
def _quiet() -> Any:
    """The exporter warns about things that hold here on purpose."""
    level = logging.getLogger("torch.onnx").level
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.getLogger("torch.onnx").setLevel(level)
