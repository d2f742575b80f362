"""`deepshade export BUNDLE --to …`: a bundle for another program, in one of several formats."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import typer

from deepshade.bundles import Bundle
from deepshade.errors import ConfigError
from deepshade.files import replacing
from deepshade_trainer.interchange import Precision, Size, check_size, facts, plain, write_plain
from deepshade_trainer.shaders import LANGUAGES, write_shaders

FORMATS = ("onnx", *LANGUAGES, "npz")
_SHADER_SIZE = 768, 512  # where nobody names one: the paper's


def export_to(
    bundle: Bundle,
    to: str,
    folder: Path,
    size: str = "dynamic",
    opset: int = 18,
    precision: str = "fp32",
    apart: bool = False,
) -> None:
    """Write a bundle to `folder` in a format, and say on stdout what it is made of.

    Raises ConfigError: a format, size, precision or opset that there is not; more as `write_plain`
    and `lower` say.
    """
    if to not in FORMATS:
        raise ConfigError("to", FORMATS, detail=f"--to {to}: there are {', '.join(FORMATS)}")
    if precision not in ("fp32", "fp16"):
        raise ConfigError("precision", detail=f"--precision {precision}: give fp32 or fp16")
    if to != "onnx" and (precision != "fp32" or apart or opset != 18):
        raise ConfigError(
            "to", detail=f"--to {to} knows no --precision, --opset or --apart: they are of onnx"
        )
    sides = _sides(size)
    check_size(bundle, sides)
    if to == "onnx":
        _onnx(bundle, folder, sides, opset, "fp16" if precision == "fp16" else "fp32", apart)
    elif to == "npz":
        if sides is not None:
            raise ConfigError("size", detail="weights have no size: leave --size out")
        _npz(bundle, folder)
    else:
        _shaders(bundle, to, folder, sides or _SHADER_SIZE)


def _sides(size: str) -> Size | None:
    width, _, height = size.partition("x")
    if size == "dynamic":
        return None
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError("size", detail=f"--size {size}: give WxH, such as 768x512, or dynamic")
    return int(width), int(height)


def _onnx(
    bundle: Bundle, folder: Path, size: Size | None, opset: int, precision: Precision, apart: bool
) -> None:
    made = write_plain(bundle, folder, size, opset, precision, apart)
    typer.echo(
        f"{made.path}: {sum(made.operators.values())} nodes of {len(made.operators)} kinds, opset "
        f"{opset}; ONNX Runtime's answers are within {made.difference:.0e} of the bundle's"
        f"{'' if precision == 'fp32' else ' on average'}"
    )
    typer.echo(", ".join(f"{count} {name}" for name, count in made.operators.most_common()))
    for taker in made.takers:
        word = "takes it" if taker.takes else "does not take it"
        typer.echo(f"{taker.engine} {word}{f': {taker.note}' if taker.note else ''}")


def _shaders(bundle: Bundle, language: str, folder: Path, size: Size) -> None:
    from deepshade_trainer.shaders.lowering import lower

    program = lower(plain(bundle, size)).shared()
    target = folder / f"{bundle.effect}-{bundle.name}-{size[0]}x{size[1]}-{language}"
    told = {key.removeprefix("deepshade:"): value for key, value in facts(bundle).items()}
    files = write_shaders(program, language, target, told)
    if language == "glsl" and bundle.network.get("kind") == "perceptron":
        from deepshade_trainer.shaders.perceptron import write_uniform_shader

        more = write_uniform_shader(bundle, target)
        typer.echo(
            f"{more[0]}: the same in one pass; its uniform buffer, {more[-1].name}, has "
            f"{more[-1].stat().st_size:,} bytes"
        )
    kernels = Counter(each.kernel for each in program.passes)
    typer.echo(
        f"{target}: {len(files)} files; {len(program.passes)} passes at {size[0]} x {size[1]}, "
        f"{4 * sum(program.buffers) / 2**20:.0f} MiB of buffers, the largest "
        f"{4 * max(program.buffers) / 2**20:.0f} MiB"
    )
    typer.echo(", ".join(f"{count} {name}" for name, count in kernels.most_common()))


def _npz(bundle: Bundle, folder: Path) -> None:
    """The weights by their names, and the graph that says what they are for."""
    from onnx.helper import get_attribute_value
    from onnx.numpy_helper import to_array

    graph = plain(bundle).graph
    weights: dict[str, Any] = {tensor.name: to_array(tensor) for tensor in graph.initializer}
    nodes = [
        {
            "operator": node.op_type,
            "inputs": list(node.input),
            "outputs": list(node.output),
            "attributes": {each.name: _told(get_attribute_value(each)) for each in node.attribute},
        }
        for node in graph.node
    ]
    document = {**facts(bundle), "nodes": nodes}
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{bundle.effect}-{bundle.name}.npz"
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, deepshade=np.array(json.dumps(document)), **weights)
    count = sum(each.size for each in weights.values())
    typer.echo(f"{path}: {len(weights)} arrays of {count} numbers; {len(nodes)} nodes")


def _told(value: Any) -> Any:
    """An attribute as JSON has it."""
    from onnx import TensorProto
    from onnx.numpy_helper import to_array

    if isinstance(value, TensorProto):
        return to_array(value).tolist()
    return value.decode() if isinstance(value, bytes) else value
