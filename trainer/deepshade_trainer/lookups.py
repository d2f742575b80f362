"""Writes bundles whose graphs look up an environment: image-based light, alone and through a lens.

Nothing is trained here: see `networks.reflections` and `networks.lens`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from deepshade.bundles import MODEL, Bundle, write_config
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky, world_to_map
from deepshade.errors import DataError
from deepshade.files import scratch
from deepshade.tensors import up
from deepshade_trainer.export import INPUT, OPSET, OUTPUT, TOLERANCE, quiet
from deepshade_trainer.graph import bytes_per_pixel, float32_marks, fold_constants, session
from deepshade_trainer.networks import from_bundle
from deepshade_trainer.networks.carrier import Carrier
from deepshade_trainer.networks.fold_unet import FoldUNet
from deepshade_trainer.networks.lens import Lens
from deepshade_trainer.networks.reflections import ATTRIBUTES, Reflections

GIVEN = ("lobes", "turn")  # of an environment
_SIDE = 96  # of the picture that parity is proven on
_COUNTED = 256  # of the picture whose memory is counted


def export_reflections(folder: Path, lobes: int = 1) -> tuple[Bundle, float]:
    """The bundle `folder` (its last two names are effect and name), and its parity: how far ONNX
    Runtime strays from torch.

    `lobes` as in `Reflections`. Raises DataError: too far.
    """
    network = {"kind": "reflections", "lobes": lobes}
    return _export(folder, Reflections(lobes), network)


def export_lens(
    folder: Path, occlusion: Bundle, blur: Bundle, lobes: int = 1
) -> tuple[Bundle, float]:
    """As `export_reflections`, seen through a lens: a chain with the shaders of two bundles.

    Their weights, and what of them may be calculated in 8 bits, are taken over. Raises DataError
    for a bundle of another kind.
    """
    network = {"kind": "lens", "lobes": lobes, "of": [occlusion.short_hash, blur.short_hash]}
    int8 = {
        **{f"occlusion.{name}": span for name, span in occlusion.int8.items()},
        **{f"blur.{name}": span for name, span in blur.int8.items()},
    }
    return _export(folder, lens(occlusion, blur, lobes), network, int8)


def lens(occlusion: Bundle, blur: Bundle, lobes: int = 1) -> Lens:
    """The chain of these bundles' networks, in evaluation mode."""
    first, second = (from_bundle(bundle.path).network for bundle in (occlusion, blur))
    if not (isinstance(first, FoldUNet) and isinstance(second, Carrier)):
        raise DataError(f"{occlusion.path} and {blur.path} don't make a chain")
    return Lens(Reflections(lobes), first, second).eval()


def _export(
    folder: Path, shader: Reflections | Lens, network: dict[str, Any], int8: Any = None
) -> tuple[Bundle, float]:
    effect = EFFECTS[folder.parent.name]
    shader.eval().prepare_export()
    folder.mkdir(parents=True, exist_ok=True)
    with scratch(folder / MODEL) as file:  # what is there stays until all is done
        given = [torch.from_numpy(picture(up(_SIDE, shader.size_multiple), effect.inputs))]
        lit = Prepared.of(sky(height=64)).inputs(GIVEN, 30.0, "y")
        given += [torch.from_numpy(lit[name]) for name in GIVEN]
        free = {2: "height", 3: "width"}
        with TemporaryDirectory() as passing, quiet(), torch.inference_mode():
            raw = Path(passing) / MODEL
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
            graph = fold_constants(raw, file)
        worst = _parity(shader, file, given)
        if not worst <= TOLERANCE:
            raise DataError(f"ONNX Runtime differs from torch by {worst:.2e}, over {TOLERANCE:.0e}")
        marks = [float32_marks(graph, prefix) for prefix in shader.rounded] or [([OUTPUT], [])]
        further = {name: tensor.numpy() for name, tensor in zip(GIVEN, given[1:], strict=True)}
        side = up(_COUNTED, shader.size_multiple)
        counted = given[0].shape[1], side, side
        config = {
            "effect": effect.name,
            "name": folder.name,
            "inputs": effect.inputs,
            "outputs": effect.outputs,
            "radius": 1.0,
            "fov": 50.0,
            "size_multiple": shader.size_multiple,
            "halo": shader.halo,
            "bytes_per_pixel": bytes_per_pixel(graph, INPUT, counted, further),
            "float32": list(dict.fromkeys(name for before, _ in marks for name in before)),
            "float32_after": [name for _, after in marks for name in after],
            "int8": int8 or {},
            "network": network,
            "environment": list(GIVEN),
            "input_name": INPUT,
            "output_name": OUTPUT,
        }
        metrics = {"parity": {"onnxruntime_vs_torch_max": worst}}
        return write_config(folder, config, metrics, graph=file), worst


def picture(
    side: int, inputs: Sequence[str] = ATTRIBUTES
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """(1, C, side, side) of these attributes: a ball before nothing, glossier to the right.

    It is a unit across, and its lower half is out of focus.
    """
    at = (np.arange(side) + 0.5) / side * 2.2 - 1.1
    x, y = np.broadcast_to(at, (side, side)), -np.broadcast_to(at[:, None], (side, side))
    square = x * x + y * y
    ball = square < 1
    z = np.sqrt(np.where(ball, 1 - square, 0))
    view = np.stack([-0.2 * x, -0.2 * y, np.ones_like(x)])
    known = {
        "normal_world": np.stack([x, y, z]) * ball,
        "normal": np.stack([x, y, z]) * ball,
        "view": view / np.linalg.norm(view, axis=0),
        "diffuse": np.broadcast_to(0.5 * ball, (3, side, side)),
        "specular": np.broadcast_to(0.5 * ball, (3, side, side)),
        "gloss": (10 ** np.clip(2 + 2 * x, 0, 4) * ball)[None],
        "position": np.stack([x, y, z - 4]) / 2 * ball,
        "focal": (20 * np.clip(-y, 0, 1))[None],
    }
    return np.concatenate([known[name] for name in inputs])[None].astype(np.float32)


def _parity(shader: Reflections | Lens, path: Path, given: list[torch.Tensor]) -> float:
    """Largest difference of both, of values over 1 relative, for a y-up and a z-up world."""
    running = session(path)
    worst = 0.0
    for axis in ("y", "z"):
        turn = torch.from_numpy(world_to_map(77.0, axis).astype(np.float32))
        inputs = [*given[:-1], turn]
        feed = {node.name: t.numpy() for node, t in zip(running.get_inputs(), inputs, strict=True)}
        ours = running.run(None, feed)[0]
        with torch.inference_mode():
            theirs = shader(*inputs).numpy()
        difference = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
        worst = max(worst, float(difference.max()))
    return worst
