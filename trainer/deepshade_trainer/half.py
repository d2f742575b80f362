"""A graph whose convolutions are in 16 bits, and nothing that would suffer by it."""

from __future__ import annotations

from typing import Any

import numpy as np

from deepshade.bundles import Bundle
from deepshade.errors import ConfigError
from deepshade_trainer.graph import CONVOLUTIONS

_MOST = 65504.0  # of float16


def halve(model: Any, bundle: Bundle) -> Any:
    """Let what lies between the bundle's marks be float16, in place; returns the graph.

    From the tensors in `float32` to those in `float32_after` (`Bundle`). What comes before, after
    and in and out stays float32. Raises ConfigError: nothing lies between them.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    inferred = onnx.shape_inference.infer_shapes(model).graph
    floats = {
        value.name
        for value in (*inferred.value_info, *inferred.input, *inferred.output)
        if value.type.tensor_type.elem_type == TensorProto.FLOAT
    }
    graph = model.graph
    weights = {tensor.name: tensor for tensor in graph.initializer}
    between = _between(graph, bundle, floats)
    if not between:
        raise ConfigError(
            "precision",
            detail=f"--precision fp16: all of {bundle.effect}/{bundle.name} is arithmetic that "
            "needs float32; export it as fp32",
        )
    halves: set[str] = set()
    nodes = []
    made: dict[tuple[str, int], str] = {}
    used: set[str] = set()

    def cast(name: str, to: int) -> str:
        if (name, to) not in made:
            made[name, to] = f"{name}/{'16' if to == TensorProto.FLOAT16 else '32'}"
            if name in weights:
                array = np.clip(numpy_helper.to_array(weights[name]), -_MOST, _MOST)
                half = array.astype(np.float16)
                graph.initializer.append(numpy_helper.from_array(half, made[name, to]))
            else:
                nodes.append(helper.make_node("Cast", [name], [made[name, to]], to=to))
        return made[name, to]

    for node in graph.node:
        inside = node.output[0] in between
        for k, name in enumerate(node.input):
            known = weights.get(name)
            is_float = name in floats or (
                known is not None and known.data_type == TensorProto.FLOAT
            )
            if inside and is_float and name not in halves and not _sizes(node, k):
                node.input[k] = cast(name, TensorProto.FLOAT16)
            elif not inside and name in halves:
                node.input[k] = cast(name, TensorProto.FLOAT)
        if inside:
            halves.update(node.output)
        nodes.append(node)
        used.update(node.input)
    answer = graph.output[0].name
    if answer in halves:
        for node in nodes:
            node.output[:] = [f"{answer}/16" if name == answer else name for name in node.output]
        nodes.append(helper.make_node("Cast", [f"{answer}/16"], [answer], to=TensorProto.FLOAT))
    del graph.node[:]
    graph.node.extend(nodes)
    kept = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    return model


def _between(graph: Any, bundle: Bundle, floats: set[str]) -> set[str]:
    """The tensors that may be float16: convolutions and what depends on them, between the marks.

    Neither what lies before `float32` marks nor after the others; and as a graph for one size may
    lack a mark that it had folded away, nothing that no such convolution has a part in.
    """
    before, after = set(bundle.float32 or ()), set(bundle.float32_after or ())
    exact = set(before)
    for node in reversed(graph.node):  # what a mark depends on, but not past the other marks
        if exact.intersection(node.output) - after:
            exact.update(name for name in node.input if name not in after)
    late: set[str] = set()
    for node in graph.node:
        if (late | after).intersection(node.input):
            late.update(name for name in node.output if name not in before)
    known = {tensor.name for tensor in graph.initializer}
    free = floats - exact - late
    found: set[str] = set()
    for node in graph.node:
        learnt = node.op_type in CONVOLUTIONS or found.intersection(node.input)
        if learnt and not known.issuperset(node.input):
            found.update(free.intersection(node.output))
    return found


def _sizes(node: Any, k: int) -> bool:
    """Whether an input says sizes, which stay float32."""
    return bool(node.op_type == "Resize" and k > 0)
