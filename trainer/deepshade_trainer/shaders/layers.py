"""The operators that are more than arithmetic on numbers, each as the pass of one kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deepshade_trainer.shaders.program import Pass, View, walk

if TYPE_CHECKING:
    from deepshade_trainer.shaders.lowering import Lowering, Value

Given = dict[str, Any]
Numbers = dict[int, int | float]
BLOCK = 4  # output channels of a convolution whose weights lie side by side
_REDUCED = 3  # axes that a sum goes over at most


def conv(low: Lowering, node: Any, given: Given, x: Value, *weights: Any) -> View:
    """Convolution; its weights in blocks of 4 output channels where their number allows."""
    x, kernel = low.view(x), _weights(weights[0])
    outputs, inner, high, wide = kernel.shape
    group = given.get("group", 1)
    rows, columns = _pads_and_steps(given, x, high, wide)
    block = BLOCK if outputs // group % BLOCK == 0 else 1
    laid = kernel.reshape(outputs // block, block, -1).swapaxes(1, 2)
    own = _planes(x, outputs, rows[2], columns[2]) | _window(rows, columns, high, wide, inner)
    own |= {20: outputs // group, 26: low.weight(laid), 27: -1, 28: block}
    if len(weights) > 1 and weights[1] is not None:
        own[27] = low.weight(weights[1])
    shape = (x.shape[0], outputs, rows[2], columns[2])
    return low.emit("conv", shape, [x, low.all_weights()], own, node.output[0])


def deconv(low: Lowering, node: Any, given: Given, x: Value, *weights: Any) -> View:
    """Transposed convolution."""
    x, kernel = low.view(x), _weights(weights[0])
    each, high, wide = kernel.shape[1:]
    group = given.get("group", 1)
    pads, steps = given.get("pads", [0] * 4), given.get("strides", [1, 1])
    extra = given.get("output_padding", [0, 0])
    if "output_shape" in given or _plain(given):
        raise ValueError(_plain(given) or "output_shape")
    sides = [
        (n - 1) * step + k - pads[axis] - pads[axis + 2] + extra[axis]
        for axis, (n, step, k) in enumerate(zip(x.shape[2:], steps, (high, wide), strict=True))
    ]
    rows, columns = (steps[0], pads[0], sides[0]), (steps[1], pads[1], sides[1])
    own = _planes(x, each * group, *sides)
    own |= _window(rows, columns, high, wide, x.shape[1] // group)
    own |= {20: each, 26: low.weight(kernel), 27: -1}
    if len(weights) > 1 and weights[1] is not None:
        own[27] = low.weight(weights[1])
    shape = (x.shape[0], each * group, *sides)
    return low.emit("deconv", shape, [x, low.all_weights()], own, node.output[0])


def pool(low: Lowering, node: Any, given: Given, x: View) -> View:
    """Mean or maximum of a window."""
    high, wide = given["kernel_shape"]
    rows, columns = _pads_and_steps(given, x, high, wide)
    own = _planes(x, x.shape[1], rows[2], columns[2]) | _window(rows, columns, high, wide, 1)
    own |= {26: int(node.op_type == "MaxPool"), 27: given.get("count_include_pad", 0)}
    return low.emit("pool", (*x.shape[:2], rows[2], columns[2]), [x], own, node.output[0])


def pad(
    low: Lowering, node: Any, given: Given, x: View, pads: Any, fill: Any = None, axes: Any = None
) -> View:
    """More around it, or less."""
    mode = given.get("mode", b"constant").decode()
    if mode not in ("constant", "edge"):
        raise ValueError(f"mode {mode}")
    rank = len(x.shape)
    along = list(range(rank)) if axes is None else [int(each) % rank for each in axes]
    before = [0] * rank
    after = [0] * rank
    for k, axis in enumerate(along):
        before[axis], after[axis] = int(pads[k]), int(pads[k + len(along)])
    shape = [n + more + less for n, more, less in zip(x.shape, before, after, strict=True)]
    source = x  # its first axes are joined where they have no padding and no gaps
    while len(before) > 1 and not any((*before[:2], *after[:2])):
        n, m, *others = source.shape
        joined = source.reshaped((n * m, *others))
        if joined is None:
            break
        source = joined
        del before[0], after[0]
    inside = [n + more + less for n, more, less in zip(source.shape, before, after, strict=True)]
    if len(inside) > 6:
        raise ValueError(f"{len(inside)} axes")
    own: Numbers = {8: int(mode == "edge"), 9: len(inside), 10: source.offset}
    own[11] = float(0 if fill is None or not np.size(fill) else np.asarray(fill).item())
    for at, values in ((13, inside), (19, before), (25, source.shape), (31, source.strides)):
        own |= {at + k: int(value) for k, value in enumerate(values)}
    return low.emit("pad", shape, [source], own, node.output[0])


def concat(low: Lowering, node: Any, given: Given, *inputs: Value) -> View:
    """Parts side by side: the passes that make them write there, where nothing else reads them."""
    parts = [low.view(each) for each in inputs]
    axis = given["axis"] % len(parts[0].shape)
    total = sum(part.shape[axis] for part in parts)
    shape = [*parts[0].shape[:axis], total, *parts[0].shape[axis + 1 :]]
    made = low.buffer(shape)
    inner = int(np.prod(shape[axis + 1 :]))
    start = 0
    for name, part in zip(node.input, parts, strict=True):
        maker = low.makers.get(name)
        if maker is None or low.uses[name] > 1 or maker.placed:
            low.copy(part, at := f"{node.output[0]}/{start}")
            maker = low.makers[at]
        maker.place(made.buffer, part.shape[axis] * inner, total * inner, start * inner)
        start += part.shape[axis]
    return made


def gather(low: Lowering, x: View, which: View, axis: int, name: str) -> View:
    """Of an axis the entries that another tensor names."""
    outer, inner = int(np.prod(x.shape[:axis])), int(np.prod(x.shape[axis + 1 :]))
    flat = low.reshaped(x, (outer, x.shape[axis], inner))
    places = low.reshaped(which, (int(np.prod(which.shape)),))
    count = places.shape[0]
    own: Numbers = {8: x.shape[axis], 9: count, 10: inner, 11: flat.offset, 15: places.offset}
    own |= {12 + k: stride for k, stride in enumerate(flat.strides)}
    if places.strides not in ((0,), (1,)):
        raise ValueError("indices with gaps")
    shape = (*x.shape[:axis], *which.shape, *x.shape[axis + 1 :])
    return low.emit("gather", shape, [flat, places], own, name)


def resize(low: Lowering, node: Any, given: Given, x: View, *rest: Any) -> View:
    """Of another size: nearest as `asymmetric` and `floor` say, or linear by `half_pixel`."""
    mode = given.get("mode", b"nearest").decode()
    way = mode, given.get("coordinate_transformation_mode", b"half_pixel").decode()
    ways = {("nearest", "asymmetric"): 0, ("linear", "half_pixel"): 1}
    if way not in ways or (mode == "nearest" and given.get("nearest_mode") != b"floor"):
        raise ValueError(" ".join(way))
    scales, sizes = (*rest[1:], None, None)[:2]
    if sizes is not None and len(sizes):
        shape = [int(n) for n in sizes]
    else:
        shape = [int(np.floor(n * s)) for n, s in zip(x.shape, scales, strict=True)]
    if tuple(shape[:2]) != x.shape[:2]:
        raise ValueError("of channels")
    own = _planes(x, shape[1], *shape[2:]) | {26: ways[way]}
    return low.emit("resize", shape, [x], own, node.output[0])


def sample(low: Lowering, node: Any, given: Given, x: Value, grid: Value) -> View:
    """Look-ups."""
    x, grid = low.view(x), low.view(grid)
    mode = given.get("mode", b"linear").decode()
    if given.get("padding_mode") != b"border" or mode not in ("nearest", "bilinear", "linear"):
        raise ValueError(f"{mode}, {given.get('padding_mode')}")
    high, wide = grid.shape[1:3]
    own = _planes(x, x.shape[1], high, wide)
    own |= {26: int(mode != "nearest"), 27: given.get("align_corners", 0), 30: grid.offset}
    own |= {31 + k: stride for k, stride in enumerate(grid.strides)}
    return low.emit("sample", (*x.shape[:2], high, wide), [x, grid], own, node.output[0])


def reduce(low: Lowering, node: Any, given: Given, x: View, axes: Any = None) -> View:
    """Sum or maximum over axes."""
    rank = len(x.shape)
    named = given.get("axes", axes)
    over = sorted({int(each) % rank for each in (range(rank) if named is None else named)})
    kept = [k for k in range(rank) if k not in over]
    outer = x.turned(x.array[(*(0 if k in over else slice(None) for k in range(rank)), ...)])
    inner = x.turned(x.array[(*(0 if k in kept else slice(None) for k in range(rank)), ...)])
    sizes, (steps,) = walk(outer.shape, [outer])
    lengths, (strides,) = walk(inner.shape, [inner])
    if len(lengths) > _REDUCED:
        raise ValueError(f"over {len(lengths)} axes")
    own: Numbers = {8: int(node.op_type == "ReduceMax"), 9: len(sizes), 10: x.offset}
    own |= {13 + k: n for k, n in enumerate(sizes)} | {19 + k: s for k, s in enumerate(steps)}
    own |= {25 + k: n for k, n in enumerate([*lengths, 1, 1, 1][:_REDUCED])}
    own |= {28 + k: s for k, s in enumerate(strides)}
    shape = [x.shape[k] for k in kept]
    if given.get("keepdims", 1):
        shape = [1 if k in over else n for k, n in enumerate(x.shape)]
    return low.emit("reduce", shape, [x], own, node.output[0])


def matmul(low: Lowering, node: Any, given: Given, x: Value, y: Value) -> View:
    """Products of matrices."""
    x, y = low.view(x), low.view(y)
    if min(len(x.shape), len(y.shape)) < 2:
        raise ValueError("a vector")
    outer = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
    rows, columns = x.shape[-2], y.shape[-1]
    batch = int(np.prod(outer))
    own: Numbers = {9: rows, 10: columns, 11: x.shape[-1]}
    sources = []
    for at, each in ((12, x), (16, y)):
        wide = each.turned(np.broadcast_to(each.array, (*outer, *each.shape[-2:])))
        if batch > 1:
            wide = low.reshaped(wide, (batch, *each.shape[-2:]))
        strides = (0, *wide.strides)[-3:]
        own |= {at: wide.offset} | {at + 1 + k: s for k, s in enumerate(strides)}
        sources.append(wide)
    return low.emit("matmul", (*outer, rows, columns), sources, own, node.output[0])


def depth_to_space(low: Lowering, node: Any, given: Given, x: View) -> View:
    """Channels unfolded into pixels."""
    count, channels, high, wide = x.shape
    side = given["blocksize"]
    left = channels // side**2
    if given.get("mode", b"DCR") == b"CRD":
        split, order = (count, left, side, side, high, wide), (0, 1, 4, 2, 5, 3)
    else:
        split, order = (count, side, side, left, high, wide), (0, 3, 4, 1, 5, 2)
    turned = low.reshaped(x, split)
    turned = turned.turned(np.transpose(turned.array, order))
    moved = low.copy(turned, node.output[0])
    return low.reshaped(moved, (count, left, high * side, wide * side))


def block(made: Pass) -> int:
    """How many numbers an invocation of its compute shader makes."""
    return int(made.numbers[28]) if made.kernel in SEVERAL else 1


def _weights(value: Any) -> NDArray[Any]:
    if not isinstance(value, np.ndarray) or value.ndim != 4:
        raise ValueError("weights that are no constant of four axes")
    return value


def _plain(given: Given) -> str:
    """What of a window no kernel knows, or ""."""
    if given.get("auto_pad", b"NOTSET") != b"NOTSET":
        return "auto_pad"
    if any(each != 1 for each in given.get("dilations", [])):
        return "dilations"
    return "ceil_mode" if given.get("ceil_mode") else ""


Axis = tuple[int, int, int]  # step, padding before, size of the result


def _pads_and_steps(given: Given, x: View, high: int, wide: int) -> tuple[Axis, Axis]:
    if _plain(given):
        raise ValueError(_plain(given))
    pads = given.get("pads", [0] * 4)
    found = [
        (step, pads[k], (n + pads[k] + pads[k + 2] - size) // step + 1)
        for k, (n, step, size) in enumerate(
            zip(x.shape[2:], given.get("strides", [1, 1]), (high, wide), strict=True)
        )
    ]
    return found[0], found[1]


def _planes(x: View, channels: int, high: int, wide: int) -> Numbers:
    """The sizes of what is made, and where the planes of `x` (N, C, H, W) are."""
    sizes: Numbers = {8: channels, 9: high, 10: wide, 18: x.shape[2], 19: x.shape[3], 21: x.offset}
    return sizes | {22 + k: stride for k, stride in enumerate(x.strides)}


def _window(rows: Axis, columns: Axis, high: int, wide: int, inner: int) -> Numbers:
    return {
        11: inner, 12: high, 13: wide, 14: rows[0], 15: columns[0], 16: rows[1], 17: columns[1]
    }  # fmt: skip


LAYERS: dict[str, Callable[..., Any]] = {
    "Conv": conv,
    "ConvTranspose": deconv,
    "AveragePool": pool,
    "MaxPool": pool,
    "Pad": pad,
    "Concat": concat,
    "Resize": resize,
    "GridSample": sample,
    "ReduceSum": reduce,
    "ReduceMax": reduce,
    "MatMul": matmul,
    "DepthToSpace": depth_to_space,
}
KERNELS: Sequence[str] = (
    "map", "conv", "deconv", "pool", "pad", "gather", "resize", "sample", "reduce", "matmul",
)  # fmt: skip
SEVERAL = {"conv"}  # whose compute shaders make a block of numbers in each invocation
