"""`deepshade export BUNDLE --to glsl|wgsl|hlsl`: passes that share buffers without a clash."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from deepshade.bundles import Bundle
from deepshade.cli import main
from deepshade.errors import DataError
from deepshade_trainer.interchange import plain
from deepshade_trainer.shaders.languages import LANGUAGES, shaders
from deepshade_trainer.shaders.lowering import lower
from deepshade_trainer.shaders.program import NUMBERS, Pass, View, walk

ROOT = Path(__file__).resolve().parents[2]
FAST = ROOT / "models" / "ao" / "fast"


def written(made: Pass) -> np.ndarray:
    """Where in its buffer a pass writes, as its shader says."""
    chunk, pitch, start = (int(n) for n in made.numbers[1:4])
    k = np.arange(made.count)
    return start + k // chunk * pitch + k % chunk


def test_shared_buffers_hold_what_each_pass_is_to_read():
    program = lower(plain(Bundle.load(FAST), (64, 64)))
    shared = program.shared()
    assert sum(shared.buffers[1:]) < sum(program.buffers[1:]) / 3  # all but the weights
    # who wrote each number last, when every tensor has a buffer and when they share some
    own = [np.full(size, -1, np.int32) for size in program.buffers]
    few = [np.full(size, -1, np.int32) for size in shared.buffers]
    for k, (one, other) in enumerate(zip(program.passes, shared.passes, strict=True)):
        assert other.target not in other.sources
        for source, place in zip(one.sources, other.sources, strict=True):
            expected = own[source]
            np.testing.assert_array_equal(few[place][: expected.size], expected)
        own[one.target][written(one)] = k
        few[other.target][written(other)] = k
    size = int(np.prod(shared.output.shape))
    answer = few[shared.output.buffer][:size]
    np.testing.assert_array_equal(answer, own[program.output.buffer][:size])
    assert answer.min() >= 0


def test_views_say_where_numpy_would_look():
    buffer = np.arange(2 * 3 * 4 * 5)
    view = View.of(1, (2, 3, 4, 5))
    array = buffer.reshape(2, 3, 4, 5)
    for cut in (np.s_[:, 1:, ::-2], np.s_[1, :, 1:3, ::2], np.s_[...]):
        part, found = view.turned(view.array[cut]), array[cut]
        for turned, expected in ((part, found), (view.turned(part.array.T), found.T)):
            sizes, (steps,) = walk(turned.shape, [turned])
            assert len(sizes) <= expected.ndim
            index = np.indices(sizes).reshape(len(sizes), -1)
            places = turned.offset + np.array(steps) @ index
            np.testing.assert_array_equal(buffer[places], expected.ravel())


@pytest.mark.parametrize("language", LANGUAGES)
def test_a_folder_holds_all_that_runs(language: str, tmp_path: Path, capsys) -> None:
    command = ["export", str(FAST), "--to", language, "--size", "64x96", "-o", str(tmp_path)]
    assert main(command) == 0
    assert "passes at 64 x 96" in capsys.readouterr().out
    folder = tmp_path / f"ao-fast-64x96-{language}"
    told = json.loads((folder / "program.json").read_text("utf-8"))
    assert told["inputs"] == [{"name": "gbuffer", "buffer": 1, "shape": [1, 6, 96, 64]}]
    assert told["output"]["shape"] == [1, 1, 96, 64]
    assert (folder / "weights.f32").stat().st_size == 4 * told["buffers"][0]
    assert (folder / "passes.i32").stat().st_size == 4 * NUMBERS * len(told["passes"])
    kernels = {each["kernel"] for each in told["passes"]}
    texts = {path.stem for path in folder.iterdir() if path.suffix not in (".json", ".f32", ".i32")}
    assert texts - {"layers"} == kernels
    assert max(max(each["groups"]) for each in told["passes"]) < 65536


def test_one_text_is_all_languages():
    for language in LANGUAGES:
        for name, text in shaders(language).items():
            assert "KERNEL" not in text, name
            if language == "wgsl":
                assert not any(word in text for word in ("float", "int ", "void")), name
            if language == "hlsl":
                assert "roundEven" not in text, name


def test_what_no_kernel_does_is_said():
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 2, 4, 4])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    for node, said in (
        (helper.make_node("Sin", ["x"], ["y"]), "no kernel does Sin"),
        (helper.make_node("MaxPool", ["x"], ["y"], kernel_shape=[2, 2], ceil_mode=1), "ceil_mode"),
        (helper.make_node("Cast", ["x"], ["y"], to=TensorProto.FLOAT16), "to type 10"),
    ):
        graph = helper.make_graph([node], "one", [x], [y])
        with pytest.raises(DataError, match=said):
            lower(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)]))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "spirv"], "there are onnx, glsl, wgsl, hlsl, npz"),
        (["--to", "glsl", "--size", "100x64"], "pad the picture to 128x64"),
        (["--to", "wgsl", "--precision", "fp16"], "knows no --precision"),
        (["--to", "npz", "--size", "64x64"], "weights have no size"),
        (["--to", "onnx", "--precision", "int8"], "give fp32 or fp16"),
    ],
)
def test_what_can_not_be_exported_is_said(words: list[str], said: str, tmp_path: Path, capsys):
    assert main(["export", str(FAST), "-o", str(tmp_path / "out"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_weights_come_with_their_names_and_their_graph(tmp_path: Path, capsys) -> None:
    assert main(["export", str(FAST), "--to", "npz", "-o", str(tmp_path)]) == 0
    with np.load(tmp_path / "ao-fast.npz", allow_pickle=False) as file:
        document = json.loads(str(file["deepshade"]))
        read = {name for node in document["nodes"] for name in node["inputs"]}
        for tensor in onnx.load(str(FAST / "model.onnx")).graph.initializer:
            if tensor.name in read:
                expected = onnx.numpy_helper.to_array(tensor)
                np.testing.assert_array_equal(file[tensor.name], expected)
        made = {name for node in document["nodes"] for name in node["outputs"]}
        assert read - made - set(file.files) <= {"gbuffer", ""}
    assert json.loads(document["deepshade:channels"])[3] == "position.X"
