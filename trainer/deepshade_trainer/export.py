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
from deepshade.bundles import INT8, MODEL, PROBE, WEIGHTS, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.errors import DataError
from deepshade.files import replacing
from deepshade.probe import Window, write_probe
from deepshade_trainer.dataset import Dataset, spread
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.quantisation import examples, quantise
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

INPUT, OUTPUT = "gbuffer", "shade"
OPSET = 18
# How far ONNX Runtime may stray from torch, both in float32, on values in [0, 1].
TOLERANCE = 1e-4
PARITY_SAMPLES = 8
PROBE_WINDOWS, PROBE_SIDE = 4, 256


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
    `data`. `radius` is the effect radius, in scene units, of requests that name none. Beside the
    graph comes its 8-bit version, quantised on training samples, and a probe from the validation
    samples, on which a machine measures what each precision costs.

    Raises:
        DataError: the difference exceeds `TOLERANCE`; no configuration is then written.
    """
    recipe, model = load_shader(run)
    effect = EFFECTS[recipe.effect]
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", INT8, PROBE):  # no bundle while its files change
        (folder / name).unlink(missing_ok=True)
    write_onnx(model, folder / MODEL)
    with replacing(folder / WEIGHTS) as temporary:
        tensors = {name: tensor.contiguous() for name, tensor in model.state_dict().items()}
        temporary.write_bytes(save(tensors))
    samples = Dataset(data, recipe.effect)
    chosen = spread(len(samples.entries), PARITY_SAMPLES)
    gbuffers = [samples.batch([number])[0] for number in chosen]
    worst = parity(model, folder / MODEL, gbuffers)
    if not worst <= TOLERANCE:
        raise DataError(f"ONNX Runtime differs from torch by {worst:.2e}, over {TOLERANCE:.0e}")
    training, held = samples.split(recipe.held_out)
    quantise(folder / MODEL, folder / INT8, INPUT, examples(samples, training))
    windows = choose_probe(samples, held or training, model.size_multiple)
    if windows:
        write_probe(folder / PROBE, recipe.effect, windows)
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
        background_halo=getattr(model, "background_halo", None),
    )
    return bundle, worst


def choose_probe(samples: Dataset, numbers: Sequence[int], multiple: int) -> list[Window]:
    """Windows of up to `PROBE_SIDE` pixels with something to see, at most one of each scene.

    Precision is lost on positions that are large against the effect radius, so the windows run
    from the smallest to the largest. Empty where samples are smaller than `multiple`.
    """
    found: dict[str, tuple[float, float, Window]] = {}
    for number in numbers:
        sample, record = samples.load(number), samples.entries[number].record
        gbuffer, reference = samples.gbuffer(sample, record["radius"]), sample[samples.reference]
        side = min(PROBE_SIDE, *reference.shape[1:]) // multiple * multiple
        if side == 0:
            continue
        top, left = ((length - side) // 2 for length in reference.shape[1:])
        inside = (slice(None), slice(top, top + side), slice(left, left + side))
        window = np.ascontiguousarray(gbuffer[inside]), np.ascontiguousarray(reference[inside])
        contrast = float(window[1].std())
        if not found or contrast > found.get(record["scene"], (0.0,))[0]:
            found[record["scene"]] = contrast, float(np.abs(window[0]).max()), window
    side = max((window[0].shape[1] for _, _, window in found.values()), default=0)
    alike = [entry for entry in found.values() if entry[2][0].shape[1] == side]
    best = sorted(alike, key=lambda entry: -entry[0])[: max(PROBE_WINDOWS, len(alike) // 3)]
    ordered = sorted(best, key=lambda entry: entry[1])
    return [ordered[k][2] for k in spread(len(ordered), PROBE_WINDOWS)]


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
