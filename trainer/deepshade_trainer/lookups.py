"""Writes bundles of image-based lighting, which look up what they answer: nothing is trained."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from deepshade.bundles import MODEL, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky, world_to_map
from deepshade.errors import DataError
from deepshade_trainer.export import INPUT, OPSET, OUTPUT, TOLERANCE, quiet
from deepshade_trainer.graph import bytes_per_pixel, fold_constants
from deepshade_trainer.networks.reflections import ATTRIBUTES, Reflections

GIVEN = ("lobes", "turn")  # of an environment
_SIDE = 96  # of the picture that parity is proven on


def export_reflections(folder: Path, lobes: int = 1) -> tuple[Bundle, float]:
    """The bundle `folder` (its last two names are effect and name), and its parity: how far ONNX
    Runtime strays from torch.

    `lobes` as in `Reflections`. Raises DataError: too far.
    """
    effect = EFFECTS[folder.parent.name]
    shader = Reflections(lobes).eval()
    folder.mkdir(parents=True, exist_ok=True)
    given = [torch.from_numpy(picture(_SIDE))]
    lit = Prepared.of(sky(height=64)).inputs(GIVEN, 30.0, "y")
    given += [torch.from_numpy(lit[name]) for name in GIVEN]
    free = {2: "height", 3: "width"}
    with TemporaryDirectory() as scratch, quiet(), torch.inference_mode():
        raw = Path(scratch) / MODEL
        torch.onnx.export(
            shader,
            tuple(given),
            str(raw),
            input_names=[INPUT, *GIVEN],
            output_names=[OUTPUT],
            dynamic_axes={INPUT: free, OUTPUT: free},
            opset_version=OPSET,
            dynamo=False,
        )
        graph = fold_constants(raw, folder / MODEL)
    worst = _parity(shader, folder / MODEL, given)
    if not worst <= TOLERANCE:
        raise DataError(f"ONNX Runtime differs from torch by {worst:.2e}, over {TOLERANCE:.0e}")
    channels = given[0].shape[1]
    further = {name: tensor.numpy() for name, tensor in zip(GIVEN, given[1:], strict=True)}
    config = {
        "effect": effect.name,
        "name": folder.name,
        "inputs": ATTRIBUTES,
        "outputs": effect.outputs,
        "radius": 1.0,
        "fov": 50.0,
        "size_multiple": 1,
        "halo": 0,
        "bytes_per_pixel": bytes_per_pixel(graph, INPUT, (channels, 256, 256), further),
        "float32": [OUTPUT],
        "network": {"kind": "reflections", "lobes": lobes},
        "environment": list(GIVEN),
        "input_name": INPUT,
        "output_name": OUTPUT,
    }
    metrics = {"parity": {"onnxruntime_vs_torch_max": worst}}
    return write_config(folder, config, metrics), worst


def picture(side: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """(1, 13, side, side) for `Reflections`: a ball before nothing, glossier to the right."""
    at = (np.arange(side) + 0.5) / side * 2.2 - 1.1
    x, y = np.broadcast_to(at, (side, side)), -np.broadcast_to(at[:, None], (side, side))
    square = x * x + y * y
    ball = square < 1
    z = np.sqrt(np.where(ball, 1 - square, 0))
    gbuffer = np.zeros((1, 13, side, side), np.float32)
    gbuffer[0, :3] = np.stack([x, y, z]) * ball
    gbuffer[0, 3:6] = np.stack([-0.2 * x, -0.2 * y, np.ones_like(x)])
    gbuffer[0, 3:6] /= np.linalg.norm(gbuffer[0, 3:6], axis=0)
    gbuffer[0, 6:12] = 0.5 * ball
    gbuffer[0, 12] = 10 ** np.clip(2 + 2 * x, 0, 4) * ball
    return gbuffer


def _parity(shader: Reflections, path: Path, given: list[torch.Tensor]) -> float:
    """Largest difference of both, of values over 1 relative, for a y-up and a z-up world."""
    import onnxruntime as ort

    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = 0.0
    for up in ("y", "z"):
        turn = torch.from_numpy(world_to_map(77.0, up).astype(np.float32))
        inputs = [*given[:-1], turn]
        feed = {node.name: t.numpy() for node, t in zip(session.get_inputs(), inputs, strict=True)}
        ours = session.run(None, feed)[0]
        with torch.inference_mode():
            theirs = shader(*inputs).numpy()
        difference = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
        worst = max(worst, float(difference.max()))
    return worst
