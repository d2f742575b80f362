"""Writes a bundle from a trained network, and proves that ONNX Runtime computes the same."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deepshade.bundles import MODEL, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing, scratch
from deepshade.tensors import up
from deepshade_trainer.dataset import Dataset, lengths, spread
from deepshade_trainer.graph import (
    bytes_per_pixel,
    float32_marks,
    fold_constants,
    int8_ranges,
    session,
)
from deepshade_trainer.networks import NetworkConfig, Shader, build
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

INPUT, OUTPUT = "gbuffer", "shade"
OPSET = 18
# How far ONNX Runtime may stray from torch, both in float32: of values up to 1, or of the value.
TOLERANCE = 1e-4
PARITY_SAMPLES, RANGE_SAMPLES = 8, 24
_SIDE = 256  # of the picture whose memory is counted


def load_shader(run: Run, network: Mapping[str, Any] | None = None) -> tuple[Recipe, Shader]:
    """A run's recipe, and its shader with averaged weights in evaluation mode.

    `network` are settings of it to change that no weights depend on.

    Raises DataError: the run has no checkpoint. ConfigError: its weights don't fit the change.
    """
    if not run.checkpoint.exists():
        raise DataError(f"{run.folder} holds no checkpoint", fix="train first: deepshade train")
    recipe = Recipe.read(run.recipe)
    recipe = recipe.changed(network=dict(network or {}))
    made, weights = build(recipe.network), run.load()[0]["average"]
    shapes = {name: each.shape for name, each in made.state_dict().items()}
    if shapes != {name: each.shape for name, each in weights.items()}:
        raise ConfigError("network", detail="--set network.… here needs other weights: train anew")
    made.load_state_dict(weights)
    return recipe, Shader(EFFECTS[recipe.effect], made).eval()


def export(
    run: Run,
    folder: Path,
    data: Sequence[Path],
    *,
    radius: float = 1.0,
    fov: float = 50.0,
    metrics: dict[str, Any] | None = None,
    network: Mapping[str, Any] | None = None,
) -> tuple[Bundle, float]:
    """The bundle `folder` (its last two names are effect and name) from `run`, and its parity.

    That is the largest difference between ONNX Runtime and torch over G-buffers of `data` that
    were not trained on, where there are such. `radius` is the effect radius, in scene units, of
    requests that name none, `fov` the horizontal angle in degrees that `data` was seen at;
    `network` as of `load_shader`.

    Raises DataError: the difference exceeds `TOLERANCE`; no configuration is then written.
    """
    recipe, shader = load_shader(run, network)
    trained, held = gbuffers(recipe, data, shader.per_channel, shader.size_multiple, shader.inputs)
    fixed = None if lengths(shader.inputs) else learnt_radius(recipe, data, shader)
    pictures, rounded = [each.numpy() for each in trained], shader.network.rounded
    return write_bundle(
        shader,
        recipe.network,
        folder,
        held,
        ranges={
            name: (
                min(float(each[:, place].min()) for each in pictures),
                max(float(each[:, place].max()) for each in pictures),
            )
            for name, place in shader.places.items()
        },
        int8=lambda graph: {} if rounded is None else int8_ranges(graph, INPUT, pictures, rounded),
        radius=fixed or radius,
        fov=fov,
        metrics=metrics,
    )


def write_bundle(
    shader: Shader,
    network: NetworkConfig,
    folder: Path,
    pictures: Sequence[Tensor],
    *,
    ranges: Mapping[str, tuple[float, float]],
    int8: Callable[[Any], Mapping[str, tuple[float, float]]],
    radius: float = 1.0,
    fov: float = 50.0,
    metrics: dict[str, Any] | None = None,
) -> tuple[Bundle, float]:
    """The bundle `folder` of a shader whose `network` is so configured, and its parity.

    That is proven on `pictures`, G-buffers (N, C, H, W); `int8` gives its entry in the
    configuration for a graph. The rest as in `export` and `Bundle`.

    Raises DataError: the difference exceeds `TOLERANCE`; no configuration is then written.
    """
    effect, rounded = shader.effect, shader.network.rounded
    folder.mkdir(parents=True, exist_ok=True)
    with scratch(folder / MODEL) as file:  # what is there stays until all is done
        graph = write_onnx(shader, file)
        given = some_light(shader)
        worst = parity(shader, file, pictures)
        if not worst <= TOLERANCE:
            raise DataError(f"ONNX Runtime differs from torch by {worst:.2e}, over {TOLERANCE:.0e}")
        side = up(_SIDE, shader.size_multiple)
        exact: tuple[list[str], list[str]] = [OUTPUT], []
        float32, after = exact if rounded is None else float32_marks(graph, rounded)
        config = {
            "effect": effect.name,
            "name": folder.name,
            "inputs": shader.inputs,
            "outputs": effect.outputs,
            "radius": radius,
            "fov": fov,
            "size_multiple": shader.size_multiple,
            "halo": shader.halo,
            "ranges": dict(ranges),
            "bytes_per_pixel": bytes_per_pixel(graph, INPUT, (shader.channels, side, side), given),
            "per_channel": shader.per_channel,
            "float32": float32,
            "float32_after": after,
            "int8": dict(int8(graph)),
            "network": asdict(network),
            **({"environment": list(given)} if given else {}),
            "input_name": INPUT,
            "output_name": OUTPUT,
        }
        metrics = {**(metrics or {}), "parity": {"onnxruntime_vs_torch_max": worst}}
        return write_config(folder, config, metrics, graph=file), worst


def gbuffers(
    recipe: Recipe,
    folders: Sequence[Path],
    per_channel: bool,
    multiple: int = 1,
    inputs: Sequence[str] = (),
) -> tuple[list[Tensor], list[Tensor]]:
    """G-buffers (N, C, H, W) of samples that were trained on, and of some that were held out.

    Where none was held out, the second are of the first.
    """
    samples = Dataset(folders, recipe.effect, per_channel=per_channel, inputs=inputs)
    training, held = samples.split(recipe.val_fraction, seed=recipe.seed)

    def some(numbers: Sequence[int], count: int) -> list[Tensor]:
        chosen = [numbers[k] for k in spread(len(numbers), count)]
        found = [samples.gbuffer(samples.load(k), samples.radius(k), multiple) for k in chosen]
        return [torch.from_numpy(gbuffer) for gbuffer in found]

    return some(training, RANGE_SAMPLES), some(held or training, PARITY_SAMPLES)


def learnt_radius(recipe: Recipe, folders: Sequence[Path], shader: Shader) -> float:
    """The radius, in scene units, of samples of which a network sees no lengths: the one it knows.

    Raises DataError: it learnt several as if they were one.
    """
    samples = Dataset(folders, recipe.effect, inputs=shader.inputs)
    found = {samples.radius(k) for k in range(len(samples.entries))}
    if EFFECTS[recipe.effect].lengths == "radius" and max(found) > 1.001 * min(found):
        raise DataError(
            f"the radii go from {min(found):g} to {max(found):g}, and the network sees no lengths",
            fix="train on one mesh, with 'deepshade datagen --radius' or none",
        )
    return max(found)


def write_onnx(shader: Shader, path: Path) -> Any:
    """The graph, written to `path`, with a free batch, height and width, and weights inside.

    Weights go by the names that the network has for them.
    """
    import onnx

    shader = deepcopy(shader).eval()
    shader.network.prepare_export()
    side = 2 * shader.size_multiple
    given = some_light(shader)
    free = {2: "height", 3: "width"}
    if not given:
        free[0] = "batch"
    with TemporaryDirectory() as scratch, replacing(path) as temporary:
        raw = Path(scratch) / MODEL
        with quiet(), torch.inference_mode():
            register = torch.onnx.register_custom_op_symbolic  # type: ignore[attr-defined]
            register("aten::expm1", _expm1, OPSET)
            torch.onnx.export(
                shader,
                (
                    torch.zeros(1, shader.channels, side, side),
                    *map(torch.from_numpy, given.values()),
                ),
                str(raw),
                input_names=[INPUT, *given],
                output_names=[OUTPUT],
                dynamic_axes={INPUT: free, OUTPUT: free},
                opset_version=OPSET,
                dynamo=False,
            )
        model = onnx.load(str(raw))
        for tensor in model.graph.initializer:
            tensor.name = tensor.name.removeprefix("network.")
        for node in model.graph.node:
            node.input[:] = [name.removeprefix("network.") for name in node.input]
        onnx.save(model, str(raw))
        model = fold_constants(raw, temporary)
        onnx.checker.check_model(model, full_check=True)
    return model


def some_light(shader: Shader) -> dict[str, NDArray[np.float32]]:
    """What the graph takes of an environment, if it does: that of a sky, askew."""
    if not shader.network.environment:
        return {}
    camera = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    return Prepared.of(sky(height=64)).inputs(shader.network.environment, 30.0, "y", lambda: camera)


def parity(shader: Shader, path: Path, pictures: Sequence[Tensor]) -> float:
    """Largest difference between ONNX Runtime (CPU, fp32) and torch, of values over 1 relative."""
    running = session(path)
    given, worst = some_light(shader), 0.0
    with torch.inference_mode():
        for gbuffer in pictures:
            ours: NDArray[np.float32] = running.run(None, {INPUT: gbuffer.numpy(), **given})[0]
            theirs = shader(gbuffer, *map(torch.from_numpy, given.values())).numpy()
            difference = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
            worst = max(worst, float(difference.max()))
    return worst


def _expm1(graph: Any, y: Any) -> Any:
    """exp(y) - 1, which ONNX lacks, as (exp(y) + 1) tanh(y / 2): exact near 0 too."""
    half = graph.op("Mul", y, graph.op("Constant", value_t=torch.tensor(0.5)))
    one = graph.op("Constant", value_t=torch.tensor(1.0))
    return graph.op("Mul", graph.op("Add", graph.op("Exp", y), one), graph.op("Tanh", half))


@contextmanager
def quiet() -> Iterator[None]:
    """The exporter warns about things that hold here on purpose."""
    level = logging.getLogger("torch.onnx").level
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.getLogger("torch.onnx").setLevel(level)
