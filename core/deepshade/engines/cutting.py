"""Cutting an OpenVINO graph in front of its first convolutions."""

from __future__ import annotations

from typing import Any

_CONVOLUTIONS = (
    "Convolution",
    "GroupConvolution",
    "ConvolutionBackpropData",
    "GroupConvolutionBackpropData",
    "MatMul",
)


def cut(model: Any) -> tuple[Any | None, Any | None]:
    """Everything that happens before any convolution as a graph of its own, and the rest.

    The rest's inputs are the model's input, if it is read there too, and then the outputs of the
    first graph in order. The first is None when nothing is calculated before the convolutions,
    the second when there are none. `model` is taken apart; calculated shapes (integers) stay with
    the graph that uses them.
    """
    from openvino import Model, opset13

    later: set[str] = set()
    fixed: set[str] = set()  # what no input has a part in
    for node in model.get_ordered_ops():
        sources = [_name(entry.get_source_output().get_node()) for entry in node.inputs()]
        if node.get_type_name() in _CONVOLUTIONS or any(name in later for name in sources):
            later.add(_name(node))
        if node.get_type_name() != "Parameter" and all(name in fixed for name in sources):
            fixed.add(_name(node))
    results = model.get_results()
    if not any(_name(node) in later for node in results):
        return model, None

    stays = later | fixed
    # From the results up, as far as what no convolution came before.
    kept: dict[str, Any] = {}
    found: dict[tuple[str, int], tuple[Any, list[Any]]] = {}
    done: set[str] = set()
    todo = list(results)
    while todo:
        node = todo.pop()
        if _name(node) in done:
            continue
        done.add(_name(node))
        for entry in node.inputs():
            output = entry.get_source_output()
            source = output.get_node()
            kind = source.get_type_name()
            if kind == "Parameter":
                kept[_name(source)] = source
            elif _name(source) in stays or output.get_element_type().is_integral_number():
                todo.append(source)
            else:
                key = (_name(source), output.get_index())
                found.setdefault(key, (output, []))[1].append(entry)
    if not found:
        return None, model
    entries = []
    for output, readers in found.values():
        given = opset13.parameter(output.get_partial_shape(), output.get_element_type())
        for entry in readers:
            entry.replace_source_output(given.output(0))
        entries.append(given)
    exact = Model([output for output, _ in found.values()], model.get_parameters(), "exact")
    return exact, Model(results, [*kept.values(), *entries], "rest")


def _name(node: Any) -> str:
    return str(node.get_friendly_name())
