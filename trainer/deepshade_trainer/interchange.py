"""A bundle's graph for other programs: for one picture size or any, of an opset of their choice."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.bench import noise
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky
from deepshade.errors import ConfigError, DataError
from deepshade.files import replacing
from deepshade.tensors import up
from deepshade_trainer.graph import fold, session

OPSETS = range(13, 19)
LICENCE = "Apache-2.0"
TOLERANCE = 1e-6  # between the graph and the bundle's own, of values up to 1, or of the value
_FREE_SIDE = 128  # of the picture that a graph of any size is compared on

Size = tuple[int, int]  # width, height


@dataclass(frozen=True, slots=True)
class Plain:
    """A graph that was written: its operators with how often each is there, and how far ONNX
    Runtime's answers by it lie from those by the bundle's own."""

    path: Path
    operators: Counter[str]
    difference: float


def write_plain(bundle: Bundle, folder: Path, size: Size | None = None, opset: int = 18) -> Plain:
    """Write a bundle's graph to `folder`/<effect>-<name>[-WxH].onnx.

    With a `size` in pixels no arithmetic on shapes is left in it, and the batch is 1; without,
    height and width are free. What one has to know to run it (`facts`) is in its metadata. Weights
    and the names of tensors are the bundle's.

    Raises ConfigError: the size is no multiple of what the network folds, or `opset` lacks an
    operator; DataError: ONNX Runtime gives another answer than by the bundle's own graph.
    """
    import onnx

    _check(bundle, size, opset)
    stem = f"{bundle.effect}-{bundle.name}" + (f"-{size[0]}x{size[1]}" if size else "")
    path = folder / f"{stem}.onnx"
    folder.mkdir(parents=True, exist_ok=True)
    model = onnx.load(str(bundle.model))
    if size is not None:
        picture = model.graph.input[0].type.tensor_type.shape.dim
        for axis, value in ((0, 1), (2, size[1]), (3, size[0])):
            picture[axis].dim_value = value
    _shape_output(model, bundle)
    with TemporaryDirectory() as scratch, replacing(path) as temporary:
        raw = Path(scratch) / "raw.onnx"
        onnx.save(model, str(raw))
        model = fold(raw, temporary)
        del model.graph.value_info[:]
        _set_opset(model, opset)
        onnx.helper.set_model_props(model, facts(bundle))
        onnx.save(model, str(temporary))
        difference = _difference(bundle, temporary, size)
        if not difference <= TOLERANCE:
            raise DataError(
                f"by the graph made of {bundle.model} ONNX Runtime's answer differs by "
                f"{difference:.1e}, over {TOLERANCE:.0e}"
            )
    return Plain(path, Counter(node.op_type for node in model.graph.node), difference)


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


def _check(bundle: Bundle, size: Size | None, opset: int) -> None:
    if opset not in OPSETS:
        raise ConfigError(
            "opset", detail=f"--opset {opset}: choose one from {OPSETS[0]} to {OPSETS[-1]}"
        )
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


def _difference(bundle: Bundle, path: Path, size: Size | None) -> float:
    """Largest difference of ONNX Runtime's answers by the two graphs, of values over 1 relative."""
    side = up(_FREE_SIDE, bundle.size_multiple)
    width, height = size or (side + bundle.size_multiple, side)
    given = {bundle.input_name: noise(bundle, height, width)[:1]}
    if bundle.environment:
        prepared = Prepared.of(sky(height=64))
        given |= prepared.inputs(bundle.environment, 30.0, "y", lambda: np.eye(3))
    theirs, ours = (_answer(graph, given) for graph in (bundle.model, path))
    apart: NDArray[np.float32] = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
    return float(apart.max())


def _answer(graph: Path, given: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
    answer: NDArray[np.float32] = session(graph).run(None, dict(given))[0]
    return answer
