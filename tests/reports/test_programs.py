"""Shader programs, run by OpenGL and WebGPU: the same numbers as ONNX Runtime gives."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from deepshade import tensors
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import EngineError
from deepshade.gbuffer import load_gbuffer
from deepshade_report import programs
from deepshade_trainer.graph import session
from deepshade_trainer.interchange import plain
from deepshade_trainer.shaders import write_shaders
from deepshade_trainer.shaders.lowering import lower

ROOT = Path(__file__).resolve().parents[2]
SIDE = 64
RUNNERS = {
    "compute": ("glsl", programs.GlCompute),
    "fragment": ("glsl", programs.GlFragment),
    "wgsl": ("wgsl", programs.WebGpu),
    "hlsl": ("hlsl", programs.Hlsl),
}


def runner(kind: str, folder: Path) -> programs.Runner:
    """Skips where the machine has no such API, software renderers included."""
    pytest.importorskip("moderngl" if RUNNERS[kind][0] == "glsl" else "wgpu")
    if kind == "hlsl" and shutil.which(programs.GLSLANG) is None:
        pytest.skip("no glslangValidator (Debian: glslang-tools)")
    try:
        return RUNNERS[kind][1](folder)
    except EngineError as error:
        pytest.skip(str(error))


def node(kind: str, inputs: str, output: str = "y", **attributes: object) -> onnx.NodeProto:
    """Inputs by their names, - for one left out."""
    names = [name.strip("-") for name in inputs.split()]
    return helper.make_node(kind, names, output.split(), **attributes)


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).normal(size=shape).astype(np.float32)


def ints(*values: int) -> np.ndarray:
    return np.array(values, np.int64)


GRID = np.random.default_rng(3).uniform(-1.2, 1.2, (1, 5, 4, 2)).astype(np.float32)
# name: nodes, shape of x, weights
GRAPHS = {
    "grouped convolution, clipped": (
        [
            node("Conv", "x w", "h", group=2, pads=[1, 0, 2, 1], strides=[2, 1]),
            node("Clip", "h low high"),
        ],
        [2, 4, 9, 7],
        {"w": normal(6, 2, 3, 2), "low": np.float32(-0.5), "high": np.float32(0.7)},
    ),
    "convolution in blocks of a slice": (
        [node("Slice", "x a z one", "h"), node("Conv", "h w b", pads=[1, 1, 1, 1])],
        [1, 5, 6, 7],
        {"a": ints(1), "z": ints(4), "one": ints(1), "w": normal(8, 3, 3, 3), "b": normal(8)},
    ),
    "transposed convolution": (
        [node("ConvTranspose", "x w b", pads=[1, 0, 0, 1], strides=[2, 3], group=2)],
        [1, 4, 5, 6],
        {"w": normal(4, 3, 3, 4), "b": normal(6)},
    ),
    "pools side by side": (
        [
            node("AveragePool", "x", "h", kernel_shape=[3, 3], pads=[1, 1, 1, 1]),
            node("MaxPool", "x", "m", kernel_shape=[3, 3], pads=[1, 1, 1, 1]),
            node("Concat", "m x h", axis=1),
        ],
        [1, 3, 7, 5],
        {},
    ),
    "padding": (
        [node("Pad", "x p", "h", mode="edge"), node("Pad", "h q v")],
        [2, 3, 4, 5],
        {
            "p": ints(0, 0, 1, 2, 0, 0, 3, 0),
            "q": ints(0, 1, 0, -1, 0, 0, 1, -2),
            "v": np.float32(2),
        },
    ),
    "resizing": (
        [
            node("Resize", "x - s", "h", mode="linear"),
            node(
                "Resize",
                "h - s",
                mode="nearest",
                coordinate_transformation_mode="asymmetric",
                nearest_mode="floor",
            ),
        ],
        [1, 2, 5, 3],
        {"s": np.array([1, 1, 3, 2], np.float32)},
    ),
    "look-ups": (
        [
            node("GridSample", "x g", "h", mode="bilinear", padding_mode="border"),
            node("GridSample", "x g", "k", mode="bilinear", padding_mode="border", align_corners=1),
            node("GridSample", "x g", "m", mode="nearest", padding_mode="border"),
            node("Concat", "h k m", axis=0),
        ],
        [1, 3, 6, 5],
        {"g": GRID},
    ),
    "gathering by calculated places": (
        [
            node("ReduceMax", "x axes", "h", keepdims=0),
            node("Floor", "h", "f"),
            node("Cast", "f", "i", to=TensorProto.INT64),
            node("Gather", "x i", axis=2),
        ],
        [1, 2, 9, 4],
        {"axes": ints(0, 1, 2)},
    ),
    "sums, turned and unfolded": (
        [
            node("DepthToSpace", "x", "d", blocksize=2, mode="CRD"),
            node("Transpose", "d", "t", perm=[0, 2, 3, 1]),
            node("ReduceSum", "t axes", "s", keepdims=1),
            node("Mul", "t s", "m"),
            node("MatMul", "m w"),
        ],
        [1, 8, 3, 4],
        {"axes": ints(1, 3), "w": normal(2, 5)},
    ),
    "choices": (
        [
            node("Split", "x", "p q", axis=1, num_outputs=2),
            node("Less", "p q", "l"),
            node("Exp", "p", "e"),
            node("Tanh", "q", "r"),
            node("Where", "l e r", "c"),
            node("Round", "c", "n"),
            node("Sub", "c n"),
        ],
        [1, 6, 4, 5],
        {},
    ),
}


def all_graphs() -> tuple[onnx.ModelProto, dict[str, int]]:
    """One model of all GRAPHS, each fed from a part of x; by name, how many numbers each gives."""
    nodes, weights, sizes, start = [], [], {}, 0
    for name, (each, shape, known) in GRAPHS.items():
        given = {f"{name}/{key}": array for key, array in known.items()}
        stop = start + int(np.prod(shape))
        given |= {f"{name}//from": ints(start), f"{name}//to": ints(stop)}
        given |= {f"{name}//shape": ints(*shape), f"{name}//flat": ints(-1)}
        weights += [numpy_helper.from_array(array, key) for key, array in given.items()]
        ends = [f"{name}//from", f"{name}//to"]
        nodes.append(helper.make_node("Slice", ["x", *ends], [f"{name}//s"]))
        nodes.append(helper.make_node("Reshape", [f"{name}//s", f"{name}//shape"], [f"{name}/x"]))
        for inner in each:
            copied = onnx.NodeProto()
            copied.CopyFrom(inner)
            copied.input[:] = [key and f"{name}/{key}" for key in inner.input]
            copied.output[:] = [f"{name}/{key}" for key in inner.output]
            nodes.append(copied)
        nodes.append(helper.make_node("Reshape", [f"{name}/y", f"{name}//flat"], [f"{name}//z"]))
        start = stop
    nodes.append(helper.make_node("Concat", [f"{name}//z" for name in GRAPHS], ["y"], axis=0))
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [start])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "all", [x], [y], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    watched = onnx.ModelProto()
    watched.CopyFrom(model)
    names = [f"{name}//z" for name in GRAPHS]
    watched.graph.output.extend(onnx.ValueInfoProto(name=each) for each in names)
    found = session(watched.SerializeToString()).run(names, {"x": np.ones(start, np.float32)})
    sizes = {name: each.size for name, each in zip(GRAPHS, found, strict=True)}
    return model, sizes


@pytest.mark.slow
@pytest.mark.parametrize("kind", RUNNERS)
def test_each_kernel_does_what_its_operator_says(kind: str, tmp_path: Path) -> None:
    model, sizes = all_graphs()
    x = normal(model.graph.input[0].type.tensor_type.shape.dim[0].dim_value)
    expected = session(model.SerializeToString()).run(None, {"x": x})[0]
    write_shaders(lower(model).shared(), RUNNERS[kind][0], tmp_path, {})
    answer = runner(kind, tmp_path).answer({"x": x})
    assert answer.shape == expected.shape
    ends = np.cumsum(list(sizes.values()))[:-1]
    for name, ours, theirs in zip(
        sizes, *map(np.split, (answer, expected), (ends, ends)), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=2e-5, rtol=2e-5, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["compute", "wgsl"])
def test_a_bundle_shades_as_onnx_runtime_does(kind: str, tmp_path: Path) -> None:
    bundle = Bundle.load(ROOT / "models" / "ao" / "fast")
    found = load_gbuffer(ROOT / "samples" / "room.exr", bundle.inputs).attributes
    part = {name: array[:, 150 : 150 + SIDE, 200 : 200 + SIDE] for name, array in found.items()}
    given = tensors.tensor(EFFECTS["ao"], part, bundle.inputs, 0.4, per_channel=False)
    expected = session(bundle.model).run(None, {"gbuffer": given})[0]
    assert expected.std() > 0.01
    write_shaders(lower(plain(bundle, (SIDE, SIDE))).shared(), RUNNERS[kind][0], tmp_path, {})
    answer = runner(kind, tmp_path).answer({"gbuffer": given})
    np.testing.assert_allclose(answer, expected, atol=1e-5)
