"""An exported ONNX graph: made smaller, and what it says of itself for a bundle's configuration."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

MIN_AFTER = 2  # convolutions that stay in float on the way to the picture
CONVOLUTIONS = {"Conv", "ConvTranspose", "MatMul", "Gemm"}
# What of ONNX Runtime's basic passes would join weights to their neighbours, or rename them.
_FUSIONS = ["ConvAdd", "ConvMul", "ConvBN", "ConvActivation", "MatMulAdd", "ReluClip", "Pad"]


def session(graph: Path | bytes, options: Any = None, **settings: Any) -> Any:
    """An ONNX Runtime session, on the CPU in float32, for a graph in a file or in bytes.

    It plans no sharing of memory, which takes time by the square of the graph's length (20 s for
    3,500 nodes) and makes predictions neither quicker nor smaller.
    """
    import onnxruntime as ort

    options = options or ort.SessionOptions()
    options.enable_mem_reuse = False
    source = graph if isinstance(graph, bytes) else str(graph)
    return ort.InferenceSession(source, options, providers=["CPUExecutionProvider"], **settings)


def fold_constants(path: Path, target: Path) -> Any:
    """Write the graph in `path` with what no input has a part in calculated once; returns it.

    Two thirds of what the exporter writes computes constant sizes and paddings. Weights keep their
    names. The graph stays plain ONNX.
    """
    import onnx

    model = fold(path, target)
    _shorten_names(model.graph)
    onnx.save(model, str(target))
    return model


def fold(path: Path, target: Path) -> Any:
    """The same, and every tensor keeps its name.

    The exporter asks of some sizes, by `If`, whether they are 1, though its own shapes say so:
    while there is one, sizes that are known become constants. With a picture of fixed size no
    arithmetic on shapes is left.
    """
    import onnx
    import onnxruntime as ort

    while True:
        options = ort.SessionOptions()
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.optimized_model_filepath = str(target)
        options.log_severity_level = 3
        session(path, options, disabled_optimizers=_FUSIONS)
        model = onnx.load(str(target))
        plain = [entry for entry in model.opset_import if entry.domain == ""]
        del model.opset_import[:]
        model.opset_import.extend(plain)
        asks = any(node.op_type == "If" for node in model.graph.node)
        if not asks or not _known_sizes(model):
            return model
        onnx.save(model, str(target))
        path = target


def float32_marks(model: Any, rounded: str = "") -> tuple[list[str], list[str]]:
    """Names of the tensors at which float32 arithmetic ends, and from which on it begins again.

    Convolutions may be calculated in 16 bits where their weights' names begin with `rounded`. What
    comes before is arithmetic on lengths and light, which 16 bits would round (`Bundle.float32`);
    but shapes stay with their users, and so do channels taken out of the picture, which is no
    arithmetic. If any may, what follows them may be rounded too, and there are no second marks.
    """
    import onnx

    graph = onnx.shape_inference.infer_shapes(model).graph
    floats = {
        value.name
        for value in (*graph.value_info, *graph.output)
        if value.type.tensor_type.elem_type == onnx.TensorProto.FLOAT
    }
    makers = {name: node for node in graph.node for name in node.output}
    constant = {tensor.name for tensor in graph.initializer}
    pictures = {value.name for value in graph.input}
    later: set[str] = set()  # what depends on such a convolution
    for node in graph.node:  # ONNX keeps them in order
        sources = list(_sources(node))
        if _convolves(node, rounded) or later.intersection(sources):
            later.update(node.output)
        elif node.op_type == "Shape" or constant.issuperset(sources):
            constant.update(node.output)
    inside: set[str] = set()  # what such a convolution depends on, and made by one
    for node in reversed(graph.node):
        if _convolves(node, rounded) or inside.intersection(node.output):
            inside.update(node.output)
            inside.update(_sources(node))
    inside &= later
    again = [
        name
        for node in graph.node
        if rounded and not inside.intersection(node.output)
        for name in _sources(node)
        if name in inside
    ]
    todo = [
        name for node in graph.node if later.intersection(node.output) for name in _sources(node)
    ]
    boundary: dict[str, None] = {}
    met: set[str] = set()
    while todo:
        name = todo.pop(0)
        if name in met or name in later or name in constant or name not in makers:
            continue
        met.add(name)
        maker = makers[name]
        if maker.op_type == "Slice" and maker.input[0] in pictures:
            continue
        if name in floats:
            boundary[name] = None
        else:
            todo += _sources(maker)
    return list(boundary), list(dict.fromkeys(again))


def bytes_per_pixel(
    model: Any,
    name: str,
    shape: tuple[int, int, int],
    further: Mapping[str, NDArray[np.float32]] | None = None,
) -> int:
    """The most memory, in bytes a pixel, that tensors take at any time of a prediction in float32.

    `shape` is (channels, height, width) of a picture for the input `name`. A tensor lives from the
    node that makes it to the last that reads it; input and output count, but not the `further`
    inputs.
    """
    import onnx

    watched = onnx.ModelProto()
    watched.CopyFrom(model)
    del watched.graph.output[:]
    names = [output for node in model.graph.node for output in node.output]
    watched.graph.output.extend(onnx.ValueInfoProto(name=each) for each in names)
    watching = session(watched.SerializeToString())
    picture = np.zeros((1, *shape), np.float32)
    sizes: dict[str, int] = {
        each: v.nbytes
        for each, v in zip(
            names, watching.run(names, {name: picture, **(further or {})}), strict=True
        )
    }
    sizes[name] = picture.nbytes
    last = {source: k for k, node in enumerate(model.graph.node) for source in _sources(node)}
    for output in model.graph.output:
        last[output.name] = len(model.graph.node)
    live = peak = sizes[name]
    for k, node in enumerate(model.graph.node):
        live += sum(sizes.get(output, 0) for output in node.output)
        peak = max(peak, live)
        gone = {source for source in _sources(node) if last[source] == k}
        live -= sum(sizes.get(source, 0) for source in gone)  # weights aren't among the sizes
    return math.ceil(peak / (shape[1] * shape[2]))


def int8_ranges(
    model: Any,
    name: str,
    pictures: Sequence[NDArray[np.float32]],
    rounded: str = "",
) -> dict[str, tuple[float, float]]:
    """The ranges of what convolutions that may run in 8 bits convolve, by their weights' names.

    `pictures` (N, C, H, W) go through the input `name`. Of the convolutions whose weights' names
    begin with `rounded`, the first stay in float, and so do the last two on the way to the picture:
    8 bits there would show, as bands and as noise on even surfaces (without the last but one 2.2 %
    more DSSIM became 0.7 %).
    """
    import onnx

    inner = [
        node
        for node in model.graph.node
        if node.op_type == "Conv" and _is_inner(node, model, rounded)
    ]
    watched = onnx.ModelProto()
    watched.CopyFrom(model)
    del watched.graph.output[:]
    names = list(dict.fromkeys(node.input[0] for node in inner))
    watched.graph.output.extend(onnx.ValueInfoProto(name=each) for each in names)
    if not names:
        return {}
    watching = session(watched.SerializeToString())
    low, high = dict.fromkeys(names, 0.0), dict.fromkeys(names, 1e-6)
    for picture in pictures:
        for each, value in zip(names, watching.run(names, {name: picture}), strict=True):
            low[each] = min(low[each], float(value.min()))
            high[each] = max(high[each], float(value.max()))
    return {node.input[1]: (low[node.input[0]], high[node.input[0]]) for node in inner}


def _known_sizes(model: Any) -> int:
    """Make constants, in place, of sizes looked up in shapes that are known; how many."""
    import onnx
    from onnx.numpy_helper import from_array, to_array

    graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
    sizes = {
        value.name: [each.dim_value for each in value.type.tensor_type.shape.dim]
        for value in (*graph.input, *graph.value_info)
        if value.type.tensor_type.HasField("shape")
    }
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    shapes = {n.output[0]: sizes.get(n.input[0]) for n in model.graph.node if n.op_type == "Shape"}
    found = []
    for node in model.graph.node:
        if node.op_type == "Gather" and shapes.get(node.input[0]) and node.input[1] in constants:
            sought = np.asarray(shapes[node.input[0]])[to_array(constants[node.input[1]])]
            if (sought > 0).all():  # 0 where it is free
                model.graph.initializer.append(from_array(sought, node.output[0]))
                found.append(node)
    for node in found:
        model.graph.node.remove(node)
    return len(found)


def _convolves(node: Any, rounded: str) -> bool:
    """Whether it is a convolution of learnt weights, whose names begin with `rounded`.

    A fixed filter, of which only a network's own weights have names, calculates with lengths.
    """
    name = node.input[1] if node.op_type in CONVOLUTIONS else ""
    return bool(name.startswith(rounded) and name.endswith(".weight"))


def _is_inner(node: Any, model: Any, rounded: str) -> bool:
    """Whether such a convolution has one or more before it and at least `MIN_AFTER` after it."""
    before: set[str] = set()
    for other in model.graph.node:  # ONNX keeps them in order
        if _convolves(other, rounded) or before.intersection(other.input):
            before.update(other.output)
    after = {output.name: 0 for output in model.graph.output}  # by tensor: how many at least
    for other in reversed(model.graph.node):
        follow = min((after[each] for each in other.output if each in after), default=None)
        if follow is None:
            continue
        if other is node:
            return _convolves(node, rounded) and follow >= MIN_AFTER and node.input[0] in before
        count = follow + (other.op_type == "Conv" and _convolves(other, rounded))
        for each in other.input:
            after[each] = min(after.get(each, count), count)
    return False


def _sources(node: Any) -> Iterator[str]:
    """The tensors that a node reads, in its branches too."""
    yield from (name for name in node.input if name)
    for attribute in node.attribute:
        if attribute.HasField("g"):
            for inner in attribute.g.node:
                yield from _sources(inner)


def _shorten_names(graph: Any) -> None:
    """Number the tensors that have no name of their own: names take more room than nodes."""
    kept = {value.name for value in (*graph.input, *graph.output)}
    kept |= {
        tensor.name for tensor in graph.initializer if not tensor.name.startswith(("/", "onnx"))
    }
    short: dict[str, str] = {}

    def rename(name: str) -> str:
        if not name or name in kept:
            return name
        return short.setdefault(name, f"t{len(short)}")

    def visit(inner: Any) -> None:
        for tensor in inner.initializer:
            tensor.name = rename(tensor.name)
        for node in inner.node:
            node.name = ""
            node.input[:] = map(rename, node.input)
            node.output[:] = map(rename, node.output)
            for attribute in node.attribute:
                if attribute.HasField("g"):
                    visit(attribute.g)
        if inner is not graph:
            for value in inner.output:
                value.name = rename(value.name)

    del graph.value_info[:]
    visit(graph)
