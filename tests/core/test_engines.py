"""Every engine and precision of this machine, against closed forms and ONNX's own evaluator."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import weakref
from dataclasses import replace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from deepshade.bundles import Bundle, write_config
from deepshade.engines import (
    Backend,
    EngineError,
    available,
    choose,
    load_engine,
    openvino,
    registry,
)
from deepshade.engines.openvino import MAX_SIZES
from deepshade.machine import resident, trim

# Of the values: rounding positions of 1000 in fp32, and the unit roundoff of bf16.
TOLERANCE = {"fp32": 2**-12, "bf16": 2**-6, "int8": 2**-5}
HERE = [backend for backend in available() if backend.precision != "int8"]
OPENVINO = Backend("openvino", "fp32")


def graph(convolutions: int = 1) -> onnx.ModelProto:
    """Slopes of the third position along x (its difference from the 4 x 4 mean), averaged.

    mean = pool 4 x 4, enlarged; difference = 8 (z - mean); then `convolutions` of 3 x 3, each a
    mean over nine neighbours.
    """
    constants = {
        "start": np.array([5], np.int64),
        "stop": np.array([6], np.int64),
        "axis": np.array([1], np.int64),
        "scales": np.array([1, 1, 4, 4], np.float32),
        "eight": np.array(8, np.float32),
        "kernel": np.full((1, 1, 3, 3), 1 / 9, np.float32),
    }
    nodes = [
        helper.make_node("Slice", ["gbuffer", "start", "stop", "axis"], ["z"]),
        helper.make_node("AveragePool", ["z"], ["mean"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Resize", ["mean", "", "scales"], ["large"], mode="nearest"),
        helper.make_node("Sub", ["z", "large"], ["offset"]),
        helper.make_node("Mul", ["offset", "eight"], ["x0"]),
    ]
    for k in range(convolutions):
        out = "shade" if k == convolutions - 1 else f"x{k + 1}"
        nodes.append(helper.make_node("Conv", [f"x{k}", "kernel"], [out], pads=[1, 1, 1, 1]))
    if not convolutions:
        nodes.append(helper.make_node("Identity", ["x0"], ["shade"]))
    made = helper.make_graph(
        nodes,
        "slopes",
        [helper.make_tensor_value_info("gbuffer", TensorProto.FLOAT, ["N", 6, "H", "W"])],
        [helper.make_tensor_value_info("shade", TensorProto.FLOAT, ["N", 1, "H", "W"])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    return model


def bundle(folder, model, *float32: str, **more) -> Bundle:
    folder.mkdir()
    (folder / "model.onnx").write_bytes(model.SerializeToString())
    config = {
        "effect": "ao",
        "name": "slopes",
        "inputs": ["normal", "position"],
        "outputs": ["Y"],
        "radius": 1.0,
        "fov": 50.0,
        "size_multiple": 4,
        "halo": 8,
        "bytes_per_pixel": 64,
        "float32": float32,
        **more,
    }
    return write_config(folder, config, {})


@pytest.fixture(scope="module")
def slopes(tmp_path_factory) -> Bundle:
    return bundle(tmp_path_factory.mktemp("engines") / "slopes", graph(), "x0")


def sliced(begin: int, end: int) -> onnx.ModelProto:
    """Convolves some channels of a G-buffer, and adds another one's square, spread to all."""
    nodes = [
        helper.make_node("Slice", ["gbuffer", "begin", "end", "axis", "step"], ["some"]),
        helper.make_node("Conv", ["some", "kernel"], ["seen"], pads=[1, 1, 1, 1]),
        helper.make_node("Slice", ["gbuffer", "two", "three", "axis", "step"], ["one"]),
        helper.make_node("Mul", ["one", "one"], ["square"]),
        helper.make_node("Add", ["seen", "square"], ["shade"]),
    ]
    kernel = np.random.default_rng(0).normal(size=(1, min(end, 6) - begin, 3, 3))
    constants = {"kernel": kernel.astype(np.float32)}
    for name, value in {
        "begin": begin,
        "end": end,
        "two": 2,
        "three": 3,
        "axis": 1,
        "step": 1,
    }.items():
        constants[name] = np.array([value])
    made = helper.make_graph(
        nodes,
        "sliced",
        [helper.make_tensor_value_info("gbuffer", TensorProto.FLOAT, ["N", 6, "H", "W"])],
        [helper.make_tensor_value_info("shade", TensorProto.FLOAT, ["N", 1, "H", "W"])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def far_away(height: int = 32, width: int = 48) -> np.ndarray:
    """A rough surface about a thousand effect radii away."""
    rng = np.random.default_rng(3)
    gbuffer = rng.normal(size=(1, 6, height, width)).astype(np.float32)
    gbuffer[:, 3:] -= 1000
    return gbuffer


def reference(model, gbuffer):
    return ReferenceEvaluator(model).run(None, {"gbuffer": gbuffer})[0]


@pytest.mark.parametrize("backend", HERE, ids=str)
def test_large_positions_lose_nothing_in_16_bits(slopes, backend):
    """bfloat16 holds 1000 to the nearest 4: were positions rounded, all slopes would be lost."""
    engine = load_engine(slopes, backend, threads=2)
    gbuffer = far_away()
    expected = reference(graph(), gbuffer)
    shade = engine.predict(gbuffer)
    assert np.abs(shade - expected).max() < TOLERANCE[backend.precision] * np.ptp(expected)
    assert shade.dtype == np.float32


@pytest.mark.parametrize("convolutions", [0, 3])
def test_graphs_without_and_with_several_convolutions(tmp_path, convolutions):
    model, gbuffer = graph(convolutions), far_away()
    expected = reference(model, gbuffer)
    made = bundle(tmp_path / "b", model, *(["x0"] if convolutions else []))
    for backend in HERE:
        shade = load_engine(made, backend, threads=1).predict(gbuffer)
        assert np.abs(shade - expected).max() < TOLERANCE[backend.precision] * np.ptp(expected)


@pytest.mark.parametrize("backend", HERE, ids=str)
def test_any_size_and_batch(slopes, backend):
    engine = load_engine(slopes, backend, threads=2)
    for shape in ((1, 6, 4, 4), (3, 6, 8, 64), (1, 6, 64, 4), (1, 6, 8, 64)):
        gbuffer = np.random.default_rng(1).normal(size=shape).astype(np.float32)
        expected = reference(graph(), gbuffer)
        assert np.abs(engine.predict(gbuffer) - expected).max() < 32 * TOLERANCE[backend.precision]
    rotated = np.random.default_rng(2).normal(size=(1, 6, 8, 16)).astype(np.float32)
    view = rotated.swapaxes(2, 3)  # not contiguous
    expected = reference(graph(), np.ascontiguousarray(view))
    assert np.abs(engine.predict(view) - expected).max() < 32 * TOLERANCE[backend.precision]


@pytest.mark.parametrize("backend", HERE, ids=str)
@pytest.mark.parametrize(("begin", "end"), [(0, 4), (3, 2**31 - 1), (2, 3)])
def test_channels_are_read_where_they_lie(tmp_path, backend, begin, end):
    model = sliced(begin, end)
    engine = load_engine(bundle(tmp_path / "b", model, "square"), backend, threads=2)
    engine.prepare(16, 24)
    rng = np.random.default_rng(1)
    for shape in ((1, 6, 8, 12), (1, 6, 16, 24), (3, 6, 16, 24)):
        gbuffer = rng.normal(size=shape).astype(np.float32)
        expected = reference(model, gbuffer)
        shade = engine.predict(gbuffer)
        assert np.abs(shade - expected).max() < TOLERANCE[backend.precision] * np.ptp(expected)


@pytest.mark.skipif(OPENVINO not in HERE, reason="OpenVINO isn't installed")
def test_openvino_tells_nobody_that_it_is_used():
    code = (
        "import sys, deepshade.engines, openvino.tools.ovc as ovc; "
        "print(type(ovc.telemetry).__module__, sys.modules['openvino_telemetry'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["openvino.tools.ovc.telemetry_stub", "None"]


@pytest.mark.skipif(OPENVINO not in HERE, reason="OpenVINO isn't installed")
def test_pieces_are_given_the_channels_that_they_take():
    from openvino import Core

    from deepshade.engines.splitting import split

    model = Core().read_model(sliced(0, 4).SerializeToString())
    first, rest = split(model, ["square"])
    assert first.exact
    assert first.channels == (slice(2, 3),)
    assert rest.channels == (slice(0, 4),)
    assert [entry.get_partial_shape()[1] for entry in rest.model.inputs] == [4, 1]
    (only,) = split(model)
    assert {(each.start, each.stop) for each in only.channels} == {(0, 4), (2, 3)}
    with pytest.raises(EngineError, match="no tensor 'cube'"):
        split(model, ["cube"])


@pytest.mark.parametrize("backend", HERE, ids=str)
def test_many_threads_at_once(slopes, backend):
    engine = load_engine(slopes, backend, threads=2)
    pictures = [far_away(8 + 4 * k, 16) + k for k in range(6)]
    expected = [engine.predict(picture).copy() for picture in pictures]
    wrong = []

    def work(k):
        for _ in range(10):
            if np.abs(engine.predict(pictures[k]) - expected[k]).max() > 1e-2:
                wrong.append(k)
            engine.shrink()

    threads = [threading.Thread(target=work, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_what_is_not_there_says_how_to_get_it(slopes):
    with pytest.raises(EngineError, match="no engine 'openvin'") as caught:
        load_engine(slopes, Backend("openvin", "fp32"), threads=1)
    assert "openvino" in caught.value.fix
    with pytest.raises(EngineError, match="no precision 'fp64'"):
        load_engine(slopes, Backend("onnxruntime", "fp64"), threads=1)
    if not any(backend.engine == "cuda" for backend in available()):
        with pytest.raises(EngineError):
            load_engine(slopes, Backend("cuda", "fp32"), threads=1)


def test_the_rule_looks_at_machine_and_bundle_alone(slopes, monkeypatch):
    """CUDA before OpenVINO before ONNX Runtime; 16 bits, or 8 where that is proven, before 32."""
    able = {"cuda": ("fp32",), "openvino": ("bf16", "int8", "fp32"), "onnxruntime": ("fp32",)}

    class Module:
        def precisions(self, engine):
            if not able[engine]:
                raise EngineError("not here")
            return able[engine]

    monkeypatch.setattr(registry, "_module", lambda engine: Module())
    monkeypatch.setattr(registry, "available", registry.available.__wrapped__)
    monkeypatch.setattr(registry, "cpu_kind", lambda: "vnni")
    proven = replace(slopes, int8={"kernel": (0.0, 1.0)}, int8_kinds=("vnni",))
    assert choose(proven) == Backend("cuda", "fp32")
    assert choose(proven, precision="bf16") == Backend("openvino", "bf16")
    able["cuda"] = ()
    assert choose(proven) == Backend("openvino", "bf16")
    able["openvino"] = ("int8", "fp32")
    assert choose(proven) == Backend("openvino", "int8")
    assert choose(slopes) == Backend("openvino", "fp32")
    monkeypatch.setattr(registry, "cpu_kind", lambda: "x86_64")
    assert choose(proven) == Backend("openvino", "fp32")
    assert choose(proven, precision="int8") == Backend("openvino", "int8")
    assert choose(slopes, "onnxruntime") == Backend("onnxruntime", "fp32")
    with pytest.raises(EngineError, match=r"no '\*/int8'") as caught:
        choose(slopes, precision="int8")
    assert "openvino/fp32" in caught.value.fix


@pytest.mark.skipif(Backend("openvino", "int8") not in available(), reason="no 8 bits here")
def test_8_bits_cost_no_more_than_their_steps(tmp_path):
    """The middle one of three convolutions in 8 bits: 256 steps over its input's range."""
    model, gbuffer = graph(3), far_away()
    names = [node.input[1] for node in model.graph.node if node.op_type == "Conv"]
    model.graph.node[-2].input[1] = "inner"
    kernel = next(t for t in model.graph.initializer if t.name == names[0])
    model.graph.initializer.append(numpy_helper.from_array(numpy_helper.to_array(kernel), "inner"))
    expected = reference(model, gbuffer)
    span = float(np.abs(expected).max() * 4)
    made = bundle(tmp_path / "b", model, "x0", int8={"inner": [-span, span]})
    exact = load_engine(made, OPENVINO, threads=1).predict(gbuffer)
    coarse = load_engine(made, Backend("openvino", "int8"), threads=1).predict(gbuffer)
    assert 0 < np.abs(coarse - exact).max() < 2 * span / 255
    wrong = bundle(tmp_path / "w", model, int8={"outer": [0, 1]})
    with pytest.raises(EngineError, match="no convolution with the weights 'outer'"):
        load_engine(wrong, Backend("openvino", "int8"), threads=1)


def test_where_openvino_miscalculates_8_bits_it_does_not_offer_them(monkeypatch):
    plain = openvino.precisions()
    monkeypatch.setattr(openvino, "cpu_kind", lambda: "amx")
    assert openvino.precisions() == tuple(name for name in plain if name != "int8")


@pytest.mark.parametrize("backend", HERE, ids=str)
def test_the_first_answer_and_the_last_are_the_same_bytes(slopes, backend):
    engine = load_engine(slopes, backend, threads=2)
    gbuffer = far_away(64, 96)
    first = engine.predict(gbuffer).tobytes()
    engine.warm()
    for size in (8, 16, 64):
        engine.predict(far_away(size, size))
    engine.shrink()
    assert all(engine.predict(gbuffer).tobytes() == first for _ in range(6))
    again = load_engine(slopes, backend, threads=2)
    assert again.predict(gbuffer).tobytes() == first


def test_a_graph_that_cannot_be_read(tmp_path):
    made = bundle(tmp_path / "b", graph())
    made.model.write_bytes(b"no graph")
    for backend in {one.engine: one for one in HERE}.values():
        with pytest.raises(EngineError):
            load_engine(made, backend, threads=1)


@pytest.mark.slow
@pytest.mark.skipif(OPENVINO not in HERE, reason="OpenVINO isn't installed")
def test_sizes_in_rotation_are_not_compiled_at_each_use(slopes):
    """13 sizes gave 351 compilations in 390 predictions when the oldest one had to go."""
    engine = load_engine(slopes, OPENVINO, threads=1)
    compile_, compiled = engine._compile, []
    engine._compile = lambda shape: compiled.append(shape) or compile_(shape)
    for _ in range(30):
        for k in range(13):
            engine.predict(far_away(8 + 4 * k, 8))
    assert len(compiled) == 13
    for _ in range(20):
        for k in range(MAX_SIZES + 1):
            engine.predict(far_away(8 + 4 * k, 8))
    assert len(compiled) < 150  # of 340; the oldest one's going would mean nearly all


@pytest.mark.parametrize("backend", HERE, ids=str)
def test_a_picture_is_not_kept(slopes, backend):
    """A service's idle engine must not hold on to the last picture's 1.6 GB."""
    engine = load_engine(slopes, backend, threads=1)
    for _ in range(2):
        gbuffer = far_away()
        gone = weakref.ref(gbuffer)
        engine.predict(gbuffer)
        del gbuffer
        gc.collect()
        assert gone() is None


@pytest.mark.slow
@pytest.mark.skipif(OPENVINO not in HERE, reason="OpenVINO isn't installed")
def test_a_large_size_keeps_no_memory(slopes):
    engine = load_engine(slopes, OPENVINO, threads=1)
    engine.prepare(64, 64)
    trim()
    before = resident()
    engine.predict(np.zeros((1, 6, 2048, 2048), np.float32))
    engine.shrink()
    trim()
    assert resident() - before < 24 * 2**20  # a channel of it is 16 MiB


@pytest.mark.slow
def test_nothing_heavy_is_imported_early():
    code = (
        "import sys, deepshade.engines; "
        "sys.exit(bool({'onnxruntime', 'openvino', 'torch'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("backend", HERE, ids=str)
def test_memory_stays_flat_over_changing_sizes(slopes, backend):
    engine = load_engine(slopes, backend, threads=2)
    engine.warm()
    rng = np.random.default_rng(0)
    levels = []
    for _ in range(3):
        for _ in range(20):
            height, width = 4 * rng.integers(1, 120, 2)
            engine.predict(np.zeros((1, 6, height, width), np.float32))
        engine.shrink()
        levels.append(resident())
    assert levels[2] - levels[0] < 32 * 2**20
