"""From a graph of one picture size to passes: node by node, moves that cost nothing left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DataError
from deepshade_trainer.shaders import layers
from deepshade_trainer.shaders.program import WEIGHTS, Pass, Program, Slot, View, walk

Array = NDArray[Any]
Value = View | Array  # where it is calculated to, or what it is

UNARY = {
    "Identity": 0, "Abs": 1, "Neg": 2, "Exp": 3, "Log": 4, "Sqrt": 5, "Reciprocal": 6, "Tanh": 7,
    "Floor": 8, "Round": 9, "Relu": 0,
}  # fmt: skip
BINARY = {
    "Add": 20, "Sub": 21, "Mul": 22, "Div": 23, "Max": 24, "Min": 25, "Pow": 26, "Less": 27,
    "Greater": 28, "Equal": 29, "LessOrEqual": 30, "GreaterOrEqual": 31, "And": 32,
}  # fmt: skip
_TRUNCATE, _CHOOSE = 10, 40
_MOST = 3.4e38


def lower(model: Any) -> Program:
    """An ONNX graph without free sizes, float32, as passes.

    Raises DataError: an operator, or a way to use one, that no kernel knows.
    """
    return Lowering(model).program()


class Lowering:
    """The state of one translation."""

    def __init__(self, model: Any) -> None:
        from onnx.numpy_helper import to_array

        self.model = model
        graph = model.graph
        self.values: dict[str, Value] = {t.name: to_array(t) for t in graph.initializer}
        self.uses = Counter(name for node in graph.node for name in node.input)
        self.uses.update(value.name for value in graph.output)
        self.makers: dict[str, Pass] = {}
        self.passes: list[Pass] = []
        self.buffers = [0]
        self.weights: list[Array] = []
        self.known: dict[Any, int] = {}

    def program(self) -> Program:
        """Every node in turn."""
        graph = self.model.graph
        inputs = []
        for entry in graph.input:
            shape = tuple(each.dim_value for each in entry.type.tensor_type.shape.dim)
            view = self.buffer(shape)
            self.values[entry.name] = view
            inputs.append(Slot(entry.name, view.buffer, shape))
        for node in graph.node:
            self.node(node)
        name = graph.output[0].name
        answer = self.value(name)
        if name not in self.makers or self.makers[name].placed:
            answer = self.copy(answer)
        output = Slot(name, answer.buffer, answer.shape)
        weights = np.concatenate(self.weights) if self.weights else np.zeros(1, np.float32)
        self.buffers[WEIGHTS] = weights.size
        return Program(inputs, output, self.buffers, self.passes, weights)

    def node(self, node: Any) -> None:
        """What a node makes: constants, another view of what is there, or a pass."""
        from onnx.helper import get_attribute_value

        given = {each.name: get_attribute_value(each) for each in node.attribute}
        inputs = [self.values[name] if name else None for name in node.input]
        if node.op_type == "Shape" and isinstance(inputs[0], View):
            made: Any = np.array(inputs[0].shape, np.int64)[given.get("start", 0) :]
        elif all(not isinstance(each, View) for each in inputs):
            made = self.constant(node)
        else:
            try:
                made = self.handler(node)(node, given, *inputs)
            except ValueError as error:
                raise DataError(f"{node.op_type} {node.output[0]}: {error}") from error
        for name, value in zip(
            node.output, made if isinstance(made, list) else [made], strict=True
        ):
            self.values[name] = value

    def handler(self, node: Any) -> Callable[..., Any]:
        """The method for an operator."""
        kind = node.op_type
        if kind in UNARY or kind in BINARY:
            return self.arithmetic
        if kind in layers.LAYERS:
            return partial(layers.LAYERS[kind], self)
        found: Callable[..., Any] | None = getattr(self, f"on_{kind.lower()}", None)
        if found is None:
            raise DataError(f"no kernel does {kind} ({node.output[0]})")
        return found

    def constant(self, node: Any) -> Any:
        """What no picture has a part in, by ONNX's own reference."""
        import onnx
        from onnx.reference import ReferenceEvaluator

        names = [name for name in node.input if name]
        outputs = [onnx.helper.make_empty_tensor_value_info(name) for name in node.output]
        inputs = [onnx.helper.make_empty_tensor_value_info(name) for name in dict.fromkeys(names)]
        graph = onnx.helper.make_graph([node], "one", inputs, outputs)
        one = onnx.helper.make_model(graph, opset_imports=self.model.opset_import)
        found = ReferenceEvaluator(one).run(None, {name: self.values[name] for name in names})
        return [np.asarray(each) for each in found]

    # What is read and written

    def buffer(self, shape: Sequence[int]) -> View:
        """A new one."""
        self.buffers.append(int(np.prod(shape)))
        return View.of(len(self.buffers) - 1, shape)

    def weight(self, array: Array, key: Any = None) -> int:
        """Where among the weights an array lies."""
        flat = np.ascontiguousarray(array, np.float32).ravel()
        key = key or (flat.tobytes(), flat.size)
        if key not in self.known:
            self.known[key] = sum(each.size for each in self.weights)
            self.weights.append(flat)
        return self.known[key]

    def all_weights(self) -> View:
        """Their buffer."""
        return View.of(WEIGHTS, [1])

    def view(self, value: Value) -> View:
        """A constant among the weights, all else where it is."""
        if isinstance(value, View):
            return value
        place = self.weight(value)
        whole = View.of(WEIGHTS, [place + value.size])
        return whole.turned(whole.array[place:].reshape(value.shape))

    def value(self, name: str) -> View:
        """A tensor by its name."""
        return self.view(self.values[name])

    def emit(
        self,
        kernel: str,
        shape: Sequence[int],
        sources: Sequence[View],
        own: dict[int, int | float],
        name: str = "",
    ) -> View:
        """A pass that makes a new tensor."""
        view = self.buffer(shape)
        places = [each.buffer for each in sources]
        made = Pass.make(kernel, view.buffer, int(np.prod(shape)), places, own)
        self.passes.append(made)
        if name:
            self.makers[name] = made
        return view

    def map(self, op: int, shape: Sequence[int], operands: Sequence[View], name: str = "") -> View:
        """Arithmetic on numbers, broadcast to a shape."""
        wide = [each.turned(np.broadcast_to(each.array, tuple(shape))) for each in operands]
        sizes, steps = walk(shape, wide)
        own: dict[int, int | float] = {8: op, 9: len(sizes)}
        own |= {13 + k: n for k, n in enumerate(sizes)}
        for j, (each, strides) in enumerate(zip(wide, steps, strict=True)):
            own[10 + j] = each.offset
            own |= {19 + 6 * j + k: s for k, s in enumerate(strides)}
        return self.emit("map", shape, operands, own, name)

    def copy(self, view: View, name: str = "") -> View:
        """The same in a buffer of its own, without gaps."""
        return self.map(0, view.shape, [view], name)

    def reshaped(self, view: View, shape: Sequence[int]) -> View:
        """In another shape, moved if it must be."""
        found = view.reshaped(shape) or self.copy(view).reshaped(shape)
        assert found is not None  # what has no gaps takes any shape
        return found

    # Arithmetic

    def arithmetic(self, node: Any, given: dict[str, Any], *inputs: Value) -> View:
        """One of the maps."""
        kind, name = node.op_type, node.output[0]
        if kind == "Relu":
            return self.on_clip(node, given, inputs[0], np.float32(0), None)
        operands = [self.view(each) for each in inputs]
        shape = np.broadcast_shapes(*(each.shape for each in operands))
        if len(operands) == 1:
            return self.map(UNARY[kind], shape, operands, name)
        if len(operands) != 2:
            raise ValueError(f"{len(operands)} operands")
        return self.map(BINARY[kind], shape, operands, name)

    def on_clip(self, node: Any, given: dict[str, Any], x: Value, low: Any, high: Any) -> View:
        """By the pass that made it, if nothing else reads what it makes."""
        bounds = [
            default if bound is None else float(np.asarray(bound))
            for bound, default in ((low, -_MOST), (high, _MOST))
        ]
        source, name = node.input[0], node.output[0]
        maker = self.makers.get(source)
        if maker is not None and self.uses[source] == 1 and maker.clamp(*bounds):
            self.makers[name] = maker
            return self.view(x)
        made = self.copy(self.view(x), name)
        self.makers[name].clamp(*bounds)
        return made

    def on_where(self, node: Any, given: dict[str, Any], *inputs: Value) -> View:
        """A choice."""
        operands = [self.view(each) for each in inputs]
        shape = np.broadcast_shapes(*(each.shape for each in operands))
        return self.map(_CHOOSE, shape, operands, node.output[0])

    def on_cast(self, node: Any, given: dict[str, Any], x: View) -> View:
        """All are float32; integers lose what is behind the point."""
        if given["to"] in (6, 7):
            return self.map(_TRUNCATE, x.shape, [x], node.output[0])
        if given["to"] != 1:
            raise ValueError(f"to type {given['to']}")
        return x

    # Moves

    def on_reshape(self, node: Any, given: dict[str, Any], x: View, sizes: Array) -> View:
        """0 keeps a size, -1 is what is left."""
        shape = [x.shape[k] if n == 0 else int(n) for k, n in enumerate(sizes)]
        return self.reshaped(x, shape)

    def on_squeeze(self, node: Any, given: dict[str, Any], x: View, axes: Array) -> View:
        """Without axes of size 1."""
        return x.turned(np.squeeze(x.array, tuple(int(each) for each in axes)))

    def on_unsqueeze(self, node: Any, given: dict[str, Any], x: View, axes: Array) -> View:
        """With more axes of size 1."""
        return x.turned(np.expand_dims(x.array, tuple(int(each) for each in axes)))

    def on_transpose(self, node: Any, given: dict[str, Any], x: View) -> View:
        """Axes in another order."""
        return x.turned(np.transpose(x.array, given.get("perm")))

    def on_expand(self, node: Any, given: dict[str, Any], x: View, sizes: Array) -> View:
        """Repeated, by strides of 0."""
        shape = np.broadcast_shapes(x.shape, tuple(int(n) for n in sizes))
        return x.turned(np.broadcast_to(x.array, shape))

    def on_slice(
        self,
        node: Any,
        given: dict[str, Any],
        x: View,
        starts: Array,
        ends: Array,
        axes: Array | None = None,
        steps: Array | None = None,
    ) -> View:
        """By strides."""
        along = range(len(starts)) if axes is None else axes
        by = np.ones(len(starts), int) if steps is None else steps
        cut = [slice(None)] * len(x.shape)
        for axis, start, end, step in zip(along, starts, ends, by, strict=True):
            stop = None if step < 0 and end < -x.shape[axis] else int(end)
            cut[axis] = slice(int(start), stop, int(step))
        return x.turned(x.array[tuple(cut)])

    def on_split(
        self, node: Any, given: dict[str, Any], x: View, sizes: Array | None = None
    ) -> list[View]:
        """Parts along an axis."""
        axis, count = given.get("axis", 0), len(node.output)
        if sizes is None:
            each = -(-x.shape[axis] // count)
            sizes = np.minimum(each, x.shape[axis] - each * np.arange(count))
        return [x.turned(part) for part in np.split(x.array, np.cumsum(sizes)[:-1], axis)]

    def on_gather(self, node: Any, given: dict[str, Any], x: Value, which: Value) -> View:
        """A view where what is taken is known and even, else a pass."""
        source, axis = self.view(x), given.get("axis", 0) % len(x.shape)
        before = (slice(None),) * axis
        if isinstance(which, np.ndarray):
            if which.ndim == 0:
                return source.turned(source.array[(*before, int(which), ...)])
            steps = np.unique(np.diff(which))
            if which.ndim == 1 and which.min() >= 0 and (which.size == 1 or steps.tolist() == [1]):
                return source.turned(source.array[(*before, slice(which[0], which[-1] + 1))])
        return layers.gather(self, source, self.view(which), axis, node.output[0])
