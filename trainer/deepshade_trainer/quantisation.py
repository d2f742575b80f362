"""The 8-bit graph of a bundle: convolutions quantised on real G-buffers, the rest in float."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.files import replacing

Image = NDArray[np.float32]


def quantise(graph: Path, target: Path, name: str, gbuffers: Sequence[Image]) -> int:
    """Write `graph` with 8-bit convolutions to `target`; returns how many there are.

    `gbuffers` (N, C, H, W) go through input `name` to find the activations' ranges. Weights have
    one scale for each output channel. What comes before the first convolutions stays in float,
    and so do the last ones, whose output is the picture: 8 bits would show as bands. With fewer
    than three convolutions in a row nothing is left to quantise: 0, and no file.
    """
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    model = onnx.load(str(graph))
    inner = _inner(model.graph)
    if not inner:
        return 0
    excluded = [n.name for n in model.graph.node if n.op_type == "Conv" and n.name not in inner]

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        """One G-buffer at a time."""

        def __init__(self) -> None:
            self._left = iter(gbuffers)

        def get_next(self) -> dict[str, Image] | None:
            """The next one's feed, None at the end."""
            gbuffer = next(self._left, None)
            return None if gbuffer is None else {name: gbuffer}

    with replacing(target) as temporary, _silent():
        quantize_static(
            str(graph),
            str(temporary),
            Reader(),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=excluded,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    return len(inner)


def _inner(graph: Any) -> set[str]:
    """Names of the convolutions with another one before and another one after them."""
    producer = {output: node for node in graph.node for output in node.output}
    before: dict[str, bool] = {}  # by tensor: whether a convolution led to it
    for node in graph.node:  # ONNX keeps them in order
        found = node.op_type == "Conv" or any(before.get(name, False) for name in node.input)
        before |= dict.fromkeys(node.output, found)
    after: set[str] = set()  # tensors that lead to a convolution
    for node in reversed(graph.node):
        if node.op_type == "Conv" or any(name in after for name in node.output):
            after |= set(node.input)
    return {
        node.name
        for node in producer.values()
        if node.op_type == "Conv"
        and before.get(node.input[0], False)
        and any(name in after for name in node.output)
    }


@contextmanager
def _silent() -> Iterator[None]:
    """It advises preparations that change nothing for these graphs, through the root logger."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(level)
