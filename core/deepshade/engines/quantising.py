"""Convolutions of an OpenVINO graph in 8 bits, made when it is loaded: weights are stored once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from deepshade.errors import EngineError


def quantise(model: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Mark convolutions of `model`, in place, to be calculated in 8 bits.

    `ranges` maps the name of a convolution's weights to the (lowest, highest) value of what it
    convolves: 256 steps between them. Weights get 255 steps around 0, each output channel its own.
    Raises EngineError if the graph lacks one of these convolutions.
    """
    from openvino import opset13

    left = dict(ranges)
    for node in model.get_ordered_ops():
        if node.get_type_name() != "Convolution":
            continue
        weights = node.input_value(1)
        name = next((name for name in weights.get_names() if name in left), None)
        if name is None:
            continue
        low, high = (np.float32(value) for value in left.pop(name))
        data = opset13.fake_quantize(node.input_value(0), low, high, low, high, 256)
        # (outputs, inputs, k, k) -> (outputs, 1, 1, 1)
        largest = np.abs(weights.get_node().data).max(axis=(1, 2, 3), keepdims=True)
        largest = np.maximum(largest, np.float32(1e-30))
        kernel = opset13.fake_quantize(weights, -largest, largest, -largest, largest, 255)
        node.input(0).replace_source_output(data.output(0))
        node.input(1).replace_source_output(kernel.output(0))
    if left:
        raise EngineError(
            f"the graph has no convolution with the weights '{next(iter(left))}'",
            fix="export the bundle again",
        )
