"""The same graph said otherwise, for engines that don't know, or get wrong, what it says."""

from __future__ import annotations

from typing import Any

import numpy as np

from deepshade.bundles import Bundle
from deepshade.tensors import channel_slices

_PACKED = 4  # channels that ONNX Runtime Web reads together


def easier(model: Any) -> Any:
    """Let operators be used only in ways that every engine knows, in place; returns the graph.

    - Pooling that counts the zeros around a picture becomes padding and pooling: Unity doesn't
      know `count_include_pad`.
    - Convolutions of 6, 9 or so channels get zeros up to 8 or 12: on WebGPU, ONNX Runtime Web
      1.30 gives wrong answers where their number is a multiple of 3 but not of 4 (its issue 29651
      is of that kind). Right are 3 and less, and all kernels of 1 x 1.
    """
    from onnx import helper, numpy_helper

    graph = model.graph
    weights = {tensor.name: tensor for tensor in graph.initializer}
    nodes = []

    def constant(name: str, array: Any) -> str:
        if name not in weights:
            weights[name] = numpy_helper.from_array(array, name)
            graph.initializer.append(weights[name])
        return name

    for node in graph.node:
        given = {each.name: helper.get_attribute_value(each) for each in node.attribute}
        if node.op_type == "AveragePool" and given.get("count_include_pad"):
            counted = any(given.get("pads", ()))
            dropped = {"count_include_pad"} | ({"pads"} if counted else set())
            kept = [each for each in node.attribute if each.name not in dropped]
            del node.attribute[:]
            node.attribute.extend(kept)
            if counted:
                top, left, bottom, right = given["pads"]
                around = np.array([0, 0, top, left, 0, 0, bottom, right], np.int64)
                name = constant(f"{node.output[0]}/pads", around)
                nodes.append(
                    helper.make_node("Pad", [node.input[0], name], [f"{node.output[0]}/padded"])
                )
                node.input[0] = f"{node.output[0]}/padded"
        elif node.op_type == "Conv" and given.get("group", 1) == 1 and node.input[1] in weights:
            kernel = numpy_helper.to_array(weights[node.input[1]])
            channels = kernel.shape[1]
            if channels > 3 and channels % 3 == 0 and channels % _PACKED and kernel[0, 0].size > 1:
                more = -channels % _PACKED
                wide = np.pad(kernel, ((0, 0), (0, more), (0, 0), (0, 0)))
                around = np.array([0, 0, 0, 0, 0, more, 0, 0], np.int64)
                name = constant(f"{node.output[0]}/pads", around)
                nodes.append(
                    helper.make_node("Pad", [node.input[0], name], [f"{node.output[0]}/padded"])
                )
                node.input[0] = f"{node.output[0]}/padded"
                weights[node.input[1]].CopyFrom(numpy_helper.from_array(wide, node.input[1]))
        nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    return model


def take_apart(model: Any, bundle: Bundle) -> None:
    """Let each attribute be an input by its own name, in place: at most three channels each."""
    from onnx import TensorProto, helper

    graph = model.graph
    picture = graph.input[0]
    sizes = [each.dim_param or each.dim_value for each in picture.type.tensor_type.shape.dim]
    places = channel_slices(bundle.inputs, bundle.per_channel)
    inputs = [
        helper.make_tensor_value_info(
            name, TensorProto.FLOAT, [sizes[0], place.stop - place.start, *sizes[2:]]
        )
        for name, place in places.items()
    ]
    others = list(graph.input)[1:]
    del graph.input[:]
    graph.input.extend([*inputs, *others])
    graph.node.insert(0, helper.make_node("Concat", list(places), [picture.name], axis=1))
