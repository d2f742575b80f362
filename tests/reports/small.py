"""A bundle of two convolutions and a data set of waves, of a factor or of light by channel."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper
from safetensors.numpy import save

from deepshade.bundles import write_config
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.gbuffer.derivation import normals_from_positions
from deepshade.manifest import Manifest, Shard

SIZE = 64


def write_bundle(folder: Path, width: int, seed: int) -> None:
    """Two 3x3 convolutions; of one colour channel where the effect is by channel."""
    effect, rng = EFFECTS[folder.parent.name], np.random.default_rng(seed)
    channels = 7 if effect.per_channel else 6
    weights = [
        numpy_helper.from_array(np.abs(rng.normal(0, 0.2, shape)).astype(np.float32), name)
        for name, shape in (("a", (width, channels, 3, 3)), ("b", (1, width, 3, 3)))
    ]
    nodes = [
        helper.make_node("Conv", ["gbuffer", "a"], ["x"], pads=[1] * 4),
        helper.make_node("Relu", ["x"], ["y"]),
        helper.make_node("Conv", ["y", "b"], ["shade"], pads=[1] * 4),
    ]
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", count, "H", "W"])
        for name, count in (("gbuffer", channels), ("shade", 1))
    ]
    graph = helper.make_graph(nodes, "tiny", ends[:1], ends[1:], weights)
    opset = [helper.make_opsetid("", 18)]
    folder.mkdir(parents=True)
    model = helper.make_model(graph, opset_imports=opset, ir_version=10)
    (folder / "model.onnx").write_bytes(model.SerializeToString())
    config: dict[str, Any] = {
        "effect": effect.name,
        "name": folder.name,
        "inputs": effect.inputs,
        "outputs": effect.outputs,
        "per_channel": effect.per_channel,
        "radius": 0.5,
        "fov": 50.0,
        "size_multiple": 8,
        "halo": 2,
        "bytes_per_pixel": 100,
    }
    write_config(folder, config, {})


def write_data(folder: Path, effect: str, count: int = 3) -> None:
    folder.mkdir(parents=True)
    samples = []
    for k in range(count):
        y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
        wave = np.sin((6 + k) * x) * np.sin(9 * y)
        depth = (4 + 0.3 * wave).astype(np.float32)
        depth[: 2 * k] = np.inf
        there = np.isfinite(depth)
        position = Camera(50, SIZE, SIZE).position_from_depth(depth)
        position[:, ~there] = 0
        sample = {
            "position": position.astype(np.float32),
            "normal": normals_from_positions(position, there).astype(np.float16),
        }
        answer = np.where(there, 0.6 - 0.35 * wave, 1)[None]
        if EFFECTS[effect].per_channel:
            answer = np.where(there, 1e5 * (0.6 - 0.35 * wave), 0) * np.ones((3, 1, 1))
            sample["light_diffuse"] = (answer * 1.5).astype(np.float32)
        samples.append({**sample, f"reference_{effect}": answer.astype(np.float32)})
    content = save({name: np.stack([s[name] for s in samples]) for name in samples[0]})
    (folder / "shard-00000.safetensors").write_bytes(content)
    camera = {"fov": 50.0, "frame": [SIZE, SIZE], "origin": [0, 0]}
    camera["world_to_camera"] = np.eye(4).tolist()
    records = [
        {"scene": f"wave:{k}", "seed": k, "radius": 0.5, "camera": camera} for k in range(count)
    ]
    schema = {n: {"dtype": str(v.dtype), "shape": list(v.shape)} for n, v in samples[0].items()}
    digest = hashlib.sha256(content).hexdigest()
    shard = Shard("shard-00000.safetensors", digest, records)
    Manifest({"test": True}, schema).with_shard(shard).write(folder)
