"""An OpenVINO graph in pieces: what must be calculated in float32, and the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from deepshade.errors import EngineError


@dataclass(frozen=True, slots=True)
class Piece:
    """A graph. Its first inputs are these `channels` of the picture, and its others the tensors
    `taken` from pieces before it; it `gives` its outputs by these names, the last piece the answer.
    An `exact` one is to be calculated in float32.
    """

    model: Any
    channels: tuple[slice, ...]
    taken: tuple[str, ...] = ()
    gives: tuple[str, ...] = ()
    exact: bool = False


def split(model: Any, float32: Sequence[str] = (), after: Sequence[str] = ()) -> list[Piece]:
    """The graph's pieces: up to the tensors named in `float32`, from there to those in `after`,
    and the rest; again by turns where names in `float32` depend on some in `after`. One without
    names.

    Where a graph begins by taking some channels of the picture, those become inputs of its own:
    they lie one after the other in memory, and to take them inside is to copy them. `model`,
    whose first input is the picture, stays as it is; others are taken by whichever piece needs
    them. Raises EngineError if it lacks such a tensor.
    """
    from openvino import opset13

    pieces: list[Piece] = []
    known: list[str] = []
    stages = _stages(model, float32, after)
    for names, exact in [*stages, ((), bool(after))]:
        part = model.clone()
        outputs = _tensors(part, names) or [node.input_value(0) for node in part.get_results()]
        entries = {_name(node): node for node in part.get_parameters()[1:]}
        for name, tensor in zip(known, _tensors(part, known), strict=True):
            entry = opset13.parameter(tensor.get_partial_shape(), tensor.get_element_type())
            for reader in tensor.get_target_inputs():
                reader.replace_source_output(entry.output(0))
            entries[name] = entry
        pieces.append(_piece(outputs, _views(part), entries, tuple(names), exact))
        known += names
    return pieces


def _stages(
    model: Any, float32: Sequence[str], after: Sequence[str]
) -> list[tuple[Sequence[str], bool]]:
    """The names by turns, exact ones first: each group depends on none of a later one."""
    names = [*float32, *after]
    makers = dict(zip(names, (out.get_node() for out in _tensors(model, names)), strict=True))
    upstream = {name: _upstream([maker]) for name, maker in makers.items()}
    left, exact = {True: list(float32), False: list(after)}, True
    found: list[tuple[Sequence[str], bool]] = []
    while left[True] or left[False]:
        others = {_name(makers[name]) for name in left[not exact]}
        ready = [n for n in left[exact] if not upstream[n] & (others - {_name(makers[n])})]
        if ready:
            found.append((ready, exact))
            left[exact] = [name for name in left[exact] if name not in ready]
        exact = not exact
    return found


def _upstream(nodes: list[Any]) -> set[str]:
    """The names of nodes and all that they depend on."""
    met: set[str] = set()
    todo = list(nodes)
    while todo:
        node = todo.pop()
        if _name(node) not in met:
            met.add(_name(node))
            todo += _sources(node)
    return met


def _tensors(model: Any, names: Sequence[str]) -> list[Any]:
    """The outputs of nodes that go by these names, in their order."""
    known = {
        name: output
        for node in model.get_ordered_ops()
        for output in node.outputs()
        for name in output.get_names()
    }
    missing = [name for name in names if name not in known]
    if missing:
        raise EngineError(
            f"the graph has no tensor '{missing[0]}', which its configuration marks as float32",
            fix="export the bundle again",
        )
    return [known[name] for name in names]


def _views(model: Any) -> dict[str, tuple[Any, slice]]:
    """The picture, and what is cut out of its channels, as inputs: name -> (input, channels)."""
    from openvino import opset13

    picture = model.get_parameters()[0]
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
    entries: dict[str, Any],
    gives: tuple[str, ...],
    exact: bool,
) -> Piece:
    """What gives `outputs`, with those of the `views` and then of the `entries` that it needs."""
    from openvino import Model

    met = _upstream([output.get_node() for output in outputs])
    used = [view for name, view in views.items() if name in met]
    taken = {name: node for name, node in entries.items() if _name(node) in met}
    model = Model(outputs, [node for node, _ in used] + list(taken.values()), "piece")
    return Piece(model, tuple(channels for _, channels in used), tuple(taken), gives, exact)


def _sources(node: Any) -> list[Any]:
    return [entry.get_source_output().get_node() for entry in node.inputs()]


def _name(node: Any) -> str:
    return str(node.get_friendly_name())
