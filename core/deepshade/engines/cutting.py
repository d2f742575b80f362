"""Cutting an OpenVINO graph in front of its first convolutions, and what each piece reads."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

_CONVOLUTIONS = (
    "Convolution",
    "GroupConvolution",
    "ConvolutionBackpropData",
    "GroupConvolutionBackpropData",
    "MatMul",
)


@dataclass(frozen=True, slots=True)
class Piece:
    """A graph. Its first inputs are these channels of the picture, and its others what the piece
    before it puts out, in order. An `exact` one is to be calculated in float32.
    """

    model: Any
    channels: tuple[slice, ...]
    exact: bool = False


def whole(model: Any) -> list[Piece]:
    """All of `model`, which is taken apart.

    Where it begins by taking some channels of the picture, those are what it is given: they lie
    one after the other in memory, and to take them is to copy them.
    """
    views = _views(model)
    return [_piece(_results(model), views)]


def cut(model: Any) -> list[Piece]:
    """Everything that happens before any convolution as a piece of its own, and the rest.

    One piece where nothing is calculated before the convolutions, or where there are none. `model`
    is taken apart; calculated shapes (integers) stay with the piece that uses them.
    """
    from openvino import opset13

    views = _views(model)
    later: set[str] = set()
    fixed: set[str] = set()  # what no input has a part in
    for node in model.get_ordered_ops():
        sources = [_name(source) for source in _sources(node)]
        if node.get_type_name() in _CONVOLUTIONS or any(name in later for name in sources):
            later.add(_name(node))
        if node.get_type_name() != "Parameter" and all(name in fixed for name in sources):
            fixed.add(_name(node))
    results = model.get_results()
    if not any(_name(node) in later for node in results):
        return [_piece(_results(model), views, exact=True)]

    stays = later | fixed
    # From the results up, as far as what no convolution came before.
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
            if source.get_type_name() == "Parameter":
                continue
            if _name(source) in stays or output.get_element_type().is_integral_number():
                todo.append(source)
            else:
                key = (_name(source), output.get_index())
                found.setdefault(key, (output, []))[1].append(entry)
    if not found:
        return [_piece(_results(model), views)]
    entries = []
    for output, readers in found.values():
        given = opset13.parameter(output.get_partial_shape(), output.get_element_type())
        for entry in readers:
            entry.replace_source_output(given.output(0))
        entries.append(given)
    first = _piece([output for output, _ in found.values()], views, exact=True)
    return [first, _piece(_results(model), views, entries)]


def _views(model: Any) -> dict[str, tuple[Any, slice]]:
    """The picture, and what is cut out of its channels, as inputs: name -> (input, channels).

    Each slice of channels becomes an input of its own. `model` has one input, the picture.
    """
    from openvino import opset13

    (picture,) = model.get_parameters()
    views = {_name(picture): (picture, slice(None))}
    for entry in picture.output(0).get_target_inputs():
        node = entry.get_node()
        if node.get_type_name() != "Slice" or entry.get_index() != 0:
            continue
        bounds = [source.data.tolist() for source in _sources(node)[1:] if hasattr(source, "data")]
        if len(bounds) != 4 or bounds[2:] != [[1], [1]]:  # first, last, step and axis
            continue
        view = opset13.parameter(node.output(0).get_partial_shape(), node.get_element_type())
        for reader in node.output(0).get_target_inputs():
            reader.replace_source_output(view.output(0))
        views[_name(view)] = view, slice(bounds[0][0], bounds[1][0])
    model.add_parameters([view for view, _ in list(views.values())[1:]])
    return views


def _piece(
    outputs: list[Any],
    views: dict[str, tuple[Any, slice]],
    entries: Iterable[Any] = (),
    *,
    exact: bool = False,
) -> Piece:
    """What gives `outputs`, with those of the `views` that it needs and then `entries`."""
    from openvino import Model

    met: set[str] = set()
    todo = [output.get_node() for output in outputs]
    while todo:
        node = todo.pop()
        if _name(node) not in met:
            met.add(_name(node))
            todo += _sources(node)
    used = [view for name, view in views.items() if name in met]
    model = Model(outputs, [node for node, _ in used] + list(entries), "piece")
    return Piece(model, tuple(channels for _, channels in used), exact)


def _results(model: Any) -> list[Any]:
    return [node.input_value(0) for node in model.get_results()]


def _sources(node: Any) -> list[Any]:
    return [entry.get_source_output().get_node() for entry in node.inputs()]


def _name(node: Any) -> str:
    return str(node.get_friendly_name())
