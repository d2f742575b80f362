"""A bundle's graph for other programs: for one picture size or any, of an opset of their choice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.bench import noise
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade.tensors import channel_slices, up
from deepshade_trainer.dialects import easier, take_apart
from deepshade_trainer.graph import fold, session
from deepshade_trainer.half import halve
from deepshade_trainer.takers import Taker, takers

OPSETS = range(13, 19)
LICENCE = "Apache-2.0"
# Between the graph and the bundle's own, of values up to 1, or of the value: `do` divides by what
# is blocked and strays by 3e-6 in a few pixels of noise, the others by 1e-6. With fp16 on average:
# on noise, which has no surfaces, single pixels flip.
TOLERANCES = {"fp32": 4e-6, "fp16": 2e-3}
_FREE_SIDE = 128  # of the picture that a graph of any size is compared on

Size = tuple[int, int]  # width, height
Precision = Literal["fp32", "fp16"]


@dataclass(frozen=True, slots=True)
class Plain:
    """A graph that was written: its operators with how often each is there, how far ONNX
    Runtime's answers by it lie from those by the bundle's own (at most; with fp16 on average), and
    which engines take it."""

    path: Path
    operators: Counter[str]
    difference: float
    takers: list[Taker]


def write_plain(
    bundle: Bundle,
    folder: Path,
    size: Size | None = None,
    opset: int = 18,
    precision: Precision = "fp32",
    apart: bool = False,
) -> Plain:
    """Write a bundle's graph to `folder`/<effect>-<name>[-WxH][-fp16].onnx.

    With a `size` in pixels no arithmetic on shapes is left in it, and the batch is 1; without,
    height and width are free. What one has to know to run it (`facts`) is in its metadata. Weights
    and the names of tensors are the bundle's. With the `precision` fp16 convolutions are in 16
    bits (`halve`); `apart`, each attribute is an input of its own, of at most three channels.

    Raises ConfigError: the size is no multiple of what the network folds, `opset` lacks an
    operator, or nothing of it may be fp16; DataError: ONNX Runtime gives another answer than by
    the bundle's own graph.
    """
    import onnx

    check_size(bundle, size)
    if opset not in OPSETS:
        raise ConfigError(
            "opset", detail=f"--opset {opset}: choose one from {OPSETS[0]} to {OPSETS[-1]}"
        )
    ending = (f"-{size[0]}x{size[1]}" if size else "") + ("-fp16" if precision == "fp16" else "")
    path = folder / f"{bundle.effect}-{bundle.name}{ending}.onnx"
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        model = plain(bundle, size)
        if precision == "fp16":
            halve(model, bundle)
        if apart:
            take_apart(model, bundle)
        _set_opset(model, opset)
        onnx.helper.set_model_props(model, _known(facts(bundle), model))
        onnx.save(model, str(temporary))
        apart_by = _difference(bundle, temporary, size)
        difference = float(apart_by.max() if precision == "fp32" else apart_by.mean())
        if not difference <= TOLERANCES[precision]:
            raise DataError(
                f"by the graph made of {bundle.model} ONNX Runtime's answer differs by "
                f"{difference:.1e}, over {TOLERANCES[precision]:.0e}"
            )
    operators = Counter(node.op_type for node in model.graph.node)
    return Plain(path, operators, difference, takers(model))


def plain(bundle: Bundle, size: Size | None = None) -> Any:
    """A bundle's graph without `If`, and for a `size` without arithmetic on shapes; see
    `write_plain`. Operators are used only in ways that engines know (`easier`).
    """
    import onnx

    model = onnx.load(str(bundle.model))
    if size is not None:
        picture = model.graph.input[0].type.tensor_type.shape.dim
        for axis, value in ((0, 1), (2, size[1]), (3, size[0])):
            picture[axis].dim_value = value
    _shape_output(model, bundle)
    with TemporaryDirectory() as scratch:
        raw = Path(scratch) / "raw.onnx"
        onnx.save(model, str(raw))
        model = fold(raw, Path(scratch) / "folded.onnx")
    del model.graph.value_info[:]
    return easier(model)


def _known(facts: dict[str, str], model: Any) -> dict[str, str]:
    """Facts that name tensors, without those that a graph for one size has folded away."""
    made = {name for node in model.graph.node for name in node.output}
    marks = {
        key: json.loads(facts[key]) for key in ("deepshade:float32", "deepshade:float32_after")
    }
    return facts | {
        key: json.dumps(names if names is None else [name for name in names if name in made])
        for key, names in marks.items()
    }


def facts(bundle: Bundle) -> dict[str, str]:
    """What an engine has to know of a bundle's graph: metadata of the graph, `deepshade:<key>`."""
    effect = EFFECTS[bundle.effect]
    known: dict[str, Any] = {
        "bundle": f"{bundle.effect}/{bundle.name}",
        "sha256": bundle.sha256,
        "licence": LICENCE,
        "channels": channels(bundle),
        "lengths": f"divided by {_DIVISORS[effect.lengths]}",
        "background": effect.background,
        "range": effect.range,
        "size_multiple": bundle.size_multiple,
        "halo": bundle.halo,
        "float32": bundle.float32,
        "float32_after": bundle.float32_after,
    }
    return {
        f"deepshade:{key}": value if isinstance(value, str) else json.dumps(value)
        for key, value in known.items()
    }


def channels(bundle: Bundle) -> list[str]:
    """The channels of its input `gbuffer`, in order, by their canonical EXR names."""
    found: list[str] = []
    for name in bundle.inputs:
        attribute = ATTRIBUTES[name]
        one = bundle.per_channel and attribute.coloured
        found += [name] if one else attribute.channels
    return found


_DIVISORS = {"radius": "the effect's radius", "depth": "the median depth of the picture's surfaces"}


def check_size(bundle: Bundle, size: Size | None) -> None:
    """Raise ConfigError unless the network takes pictures of a size."""
    multiple = bundle.size_multiple
    if size and (min(size) < 1 or size[0] % multiple or size[1] % multiple):
        width, height = (up(max(1, side), multiple) for side in size)
        raise ConfigError(
            "size",
            detail=f"--size {size[0]}x{size[1]}: {bundle.effect}/{bundle.name} takes multiples of "
            f"{multiple}; pad the picture to {width}x{height}",
        )


def _shape_output(model: Any, bundle: Bundle) -> None:
    """The answer has the picture's batch and size, and the effect's channels."""
    picture = model.graph.input[0].type.tensor_type.shape.dim
    answer = model.graph.output[0].type.tensor_type.shape.dim
    for axis in (0, 2, 3):
        answer[axis].CopyFrom(picture[axis])
    answer[1].dim_value = 1 if bundle.per_channel else len(bundle.outputs)


def _set_opset(model: Any, opset: int) -> None:
    """Graphs use of opset 18 only what earlier ones have too, or they don't pass the check."""
    wrong = _refused(model, opset)
    if wrong:
        lowest = next(each for each in OPSETS if not _refused(model, each))
        raise ConfigError(
            "opset", detail=f"--opset {opset}: {wrong}; the lowest for this graph is {lowest}"
        )


def _refused(model: Any, opset: int) -> str:
    """Make it one of that opset, in place; what ONNX says against that, or ""."""
    import onnx

    next(entry for entry in model.opset_import if entry.domain == "").version = opset
    try:
        for node in model.graph.node:
            known = onnx.defs.get_schema(node.op_type, opset).attributes
            newest = onnx.defs.get_schema(node.op_type, OPSETS[-1]).attributes
            for attribute in list(node.attribute):  # what only says that a later default holds
                default = newest[attribute.name].default_value
                if attribute.name not in known and onnx.helper.get_attribute_value(
                    attribute
                ) == onnx.helper.get_attribute_value(default):
                    node.attribute.remove(attribute)
        onnx.checker.check_model(model, full_check=True)
    except (
        onnx.defs.SchemaError,
        onnx.checker.ValidationError,
        onnx.shape_inference.InferenceError,
    ) as error:
        return str(error).strip().splitlines()[0][:160].rstrip(" .")
    return ""


def _difference(bundle: Bundle, path: Path, size: Size | None) -> NDArray[np.float32]:
    """How far ONNX Runtime's answers by the two lie apart on noise, of values over 1 relative."""
    side = up(_FREE_SIDE, bundle.size_multiple)
    width, height = size or (side + bundle.size_multiple, side)
    picture = noise(bundle, height, width)[:1]
    given = {bundle.input_name: picture}
    places = channel_slices(bundle.inputs, bundle.per_channel)
    given |= {name: picture[:, place] for name, place in places.items()}
    if bundle.environment:
        prepared = Prepared.of(sky(height=64))
        given |= prepared.inputs(bundle.environment, 30.0, "y", lambda: np.eye(3))
    theirs, ours = (_answer(graph, given) for graph in (bundle.model, path))
    apart: NDArray[np.float32] = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
    return apart


def _answer(graph: Path, given: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    """By a graph that takes some of what is given."""
    running = session(graph)
    feed = {entry.name: given[entry.name] for entry in running.get_inputs()}
    answer: NDArray[np.float32] = running.run(None, feed)[0]
    return answer
