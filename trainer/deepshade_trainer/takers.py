"""Which engines take a graph, by the operators that their documentation names.

Unity: the page "Supported ONNX operators" of Sentis (Inference Engine) 2.6. Unreal: its plugin
NNERuntimeORT is ONNX Runtime, with all operators on the CPU; of NNERuntimeRDGHlsl Epic says that it
lacks some, and which is in no page. ONNX Runtime Web: `docs/webgpu-operators.md` of the package
onnxruntime-web 1.30; what that lacks runs in WebAssembly, in the same session. OpenVINO: the page
"Supported Operations", ONNX.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

# Of the operators that our graphs may hold
_UNITY_LACKS = {"If", "Loop", "Scan"}
_WEBGPU_LACKS = {"And", "ConstantOfShape", "Max", "Min", "Round"}
_FLOAT16 = 10


@dataclass(frozen=True, slots=True)
class Taker:
    """An engine: whether it takes the graph, and what is to be said of that."""

    engine: str
    takes: bool
    note: str = ""


def takers(model: Any) -> list[Taker]:
    """What each engine's documentation says of an ONNX graph."""
    kinds = {node.op_type for node in model.graph.node}
    wrong = [f"no {kind}" for kind in sorted(kinds & _UNITY_LACKS)] + list(_refused(model))
    half = any(tensor.data_type == _FLOAT16 for tensor in model.graph.initializer)
    if half:
        wrong.append("no 16-bit floats among its types")
    slow = sorted(kinds & _WEBGPU_LACKS)
    beside = f"on WebGPU, and in WebAssembly what that lacks: {', '.join(slow)}" if slow else ""
    return [
        Taker("Unity Inference Engine", not wrong, ", ".join(dict.fromkeys(wrong))),
        Taker("Unreal NNE (NNERuntimeORT)", True),
        Taker("ONNX Runtime Web", True, beside),
        Taker("OpenVINO", True),
    ]


def _refused(model: Any) -> Iterable[str]:
    """Ways to use operators that Unity's page excludes."""
    from onnx.helper import get_attribute_value

    for node in model.graph.node:
        given = {each.name: get_attribute_value(each) for each in node.attribute}
        if node.op_type in ("AveragePool", "MaxPool"):
            if given.get("ceil_mode"):
                yield f"{node.op_type} with ceil_mode"
            if given.get("count_include_pad") and any(given.get("pads", ())):
                yield "AveragePool with count_include_pad"
            if any(each != 1 for each in given.get("dilations", ())):
                yield "MaxPool with dilations"
        elif node.op_type == "ConvTranspose" and "output_shape" in given:
            yield "ConvTranspose with output_shape"
