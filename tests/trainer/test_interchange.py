"""`deepshade export BUNDLE --to onnx`: the same answers by graphs that any runtime takes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest

from deepshade import tensors
from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.effects import EFFECTS
from deepshade.gbuffer import load_gbuffer
from deepshade_trainer.dialects import easier
from deepshade_trainer.graph import session
from deepshade_trainer.interchange import write_plain
from deepshade_trainer.takers import takers

ROOT = Path(__file__).resolve().parents[2]
MODELS = ROOT / "models"
HEIGHT, WIDTH = 128, 96
ON_SHAPES = {"If", "Shape", "ConstantOfShape", "Range", "Expand"}


def gbuffer(bundle: Bundle) -> np.ndarray:
    """A part of the shipped picture."""
    found = load_gbuffer(ROOT / "samples" / "room.exr", bundle.inputs).attributes
    part = {name: array[:, -HEIGHT:, 200 : 200 + WIDTH] for name, array in found.items()}
    return tensors.tensor(EFFECTS[bundle.effect], part, bundle.inputs, 0.4, per_channel=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size"),
    [("ao/fast", (WIDTH, HEIGHT)), ("ao/fast", None), ("dof/balanced", (WIDTH, HEIGHT))],
)
def test_answers_are_the_bundles(name: str, size: tuple[int, int] | None, tmp_path: Path) -> None:
    bundle = Bundle.load(MODELS / name)
    made = write_plain(bundle, tmp_path, size, 13)
    model = onnx.load(str(made.path))
    onnx.checker.check_model(model, full_check=True)
    kinds = {node.op_type for node in model.graph.node}
    assert not kinds & (ON_SHAPES if size else {"If"})
    assert [entry.version for entry in model.opset_import] == [13]
    given = {"gbuffer": gbuffer(bundle)}
    ours, theirs = session(made.path), session(bundle.model)
    expected = theirs.run(None, given)[0]
    assert expected.std() > 0.01
    np.testing.assert_allclose(ours.run(None, given)[0], expected, atol=1e-5)
    assert ours.get_outputs()[0].shape[1:] == (
        [len(bundle.outputs), HEIGHT, WIDTH] if size else [len(bundle.outputs), "height", "width"]
    )
    facts = ours.get_modelmeta().custom_metadata_map
    assert len(json.loads(facts["deepshade:channels"])) == bundle.channels
    known = {out for node in model.graph.node for out in node.output}
    assert set(json.loads(facts["deepshade:float32"])) <= known


@pytest.mark.slow
def test_16_bits_and_an_input_for_each_attribute(tmp_path: Path) -> None:
    bundle = Bundle.load(MODELS / "ao/fast")
    made = write_plain(bundle, tmp_path, (WIDTH, HEIGHT), 15, "fp16", apart=True)
    model = onnx.load(str(made.path))
    onnx.checker.check_model(model, full_check=True)
    kinds = {each.data_type for each in model.graph.initializer if len(each.dims) == 4}
    assert kinds == {onnx.TensorProto.FLOAT16}
    given = gbuffer(bundle)
    apart = {"normal": given[:, :3], "position": given[:, 3:]}
    answer = session(made.path).run(None, apart)[0]
    expected = session(bundle.model).run(None, {"gbuffer": given})[0]
    assert answer.dtype == np.float32
    assert 0 < np.abs(answer - expected).max() < 0.005
    assert {each.engine: each.takes for each in made.takers}["Unity Inference Engine"] is False


@pytest.mark.slow
def test_16_bits_are_for_convolutions_alone_at_one_size_too(tmp_path: Path) -> None:
    """`gi` blends cells by the places of pixels, in float32; folding the size lost one mark."""
    bundle = Bundle.load(MODELS / "gi/balanced")
    made = write_plain(bundle, tmp_path, (WIDTH, HEIGHT), precision="fp16")
    given = {"gbuffer": gbuffer(bundle)}
    program = session(made.path)
    expected = session(bundle.model).run(None, given)[0]
    assert expected.std() > 1e-3
    assert np.abs(program.run(None, given)[0] - expected).max() < 0.005 * expected.max()
    outputs = {name for node in onnx.load(str(made.path)).graph.node for name in node.output}
    facts = program.get_modelmeta().custom_metadata_map
    assert set(json.loads(facts["deepshade:float32"])) <= outputs


def test_what_engines_get_wrong_is_said_otherwise() -> None:
    helper = onnx.helper
    rng = np.random.default_rng(0)
    weights = {
        "six": rng.normal(size=(4, 6, 3, 3)).astype(np.float32),
        "three": rng.normal(size=(2, 3, 2, 2)).astype(np.float32),
    }
    nodes = [
        helper.make_node(
            "AveragePool", ["x"], ["p"], kernel_shape=[3, 3], pads=[1, 0, 2, 1], count_include_pad=1
        ),
        helper.make_node("Conv", ["p", "six"], ["a"], pads=[1, 1, 1, 1]),
        helper.make_node("Split", ["p"], ["q", "r"], axis=1, num_outputs=2),
        helper.make_node("Conv", ["q", "three"], ["b"], pads=[0, 1, 0, 1], strides=[1, 1]),
        helper.make_node("Concat", ["a", "a"], ["y"], axis=1),
    ]
    x = helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 6, 8, 9])
    outputs = [helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, None) for n in ("y", "b")]
    known = [onnx.numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "one", [x], outputs, known)
    opsets = [helper.make_opsetid("", 18)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=10)
    given = {"x": rng.normal(size=(1, 6, 8, 9)).astype(np.float32)}
    expected = session(model.SerializeToString()).run(None, given)
    unity = takers(model)[0]
    assert not unity.takes
    assert "count_include_pad" in unity.note
    answer = session(easier(model).SerializeToString()).run(None, given)
    for ours, theirs in zip(answer, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert takers(model)[0].takes
    widths = [t.dims[1] for t in model.graph.initializer if t.name in weights]
    assert widths == [8, 3]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ao/fast", "--size", "100x64"], "multiples of 32; pad the picture to 128x64"),
        (["ao/fast", "--size", "big"], "give WxH"),
        (["ao/fast", "--opset", "12"], "from 13 to 18"),
        (["ibl/balanced", "--opset", "13"], "the lowest for this graph is 16"),
        (["ibl/balanced", "--precision", "fp16"], "needs float32; export it as fp32"),
    ],
)
def test_what_can_not_be_is_said(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle, *options = words
    command = ["export", str(MODELS / bundle), "--to", "onnx", "-o", str(tmp_path), *options]
    assert main(command) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
