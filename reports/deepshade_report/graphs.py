"""The tables of docs/onnx.md, from the bundles themselves.

`python -m deepshade_report.graphs` replaces what stands between the marks; a test holds the page to
what it would write.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.files import replacing

PAGE = Path("docs/onnx.md")
_MARKED = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_LENGTHS = {"radius": "the effect's radius", "depth": "the median depth"}
_AFTER = {"shaded": "as it comes", "light": "put `light`"}


def filled(text: str, models: Path) -> str:
    """The page's text with its tables made anew from the bundles in `models`."""
    bundles = [Bundle.load(folder) for folder in bundle_folders(models)]
    effects = [EFFECTS[name] for name in dict.fromkeys(bundle.effect for bundle in bundles)]
    made = {
        "graphs": _graphs(bundles),
        "inputs": _inputs(effects),
        "operators": _operators(bundles),
    }
    return _MARKED.sub(lambda mark: mark[1] + "\n".join(made[mark[2]]) + "\n" + mark[3], text)


def _graphs(bundles: Sequence[Bundle]) -> list[str]:
    """What each graph takes and gives."""
    lines = [
        "| bundle | `gbuffer` | further inputs | `shade` | values | size multiple | halo |",
        "|---|---|---|---|---|---|---|",
    ]
    for bundle in bundles:
        low, high = EFFECTS[bundle.effect].range
        graph = _load(bundle).graph
        picture, *others = ([_size(d) for d in _dimensions(each)] for each in graph.input)
        further = [
            f"`{entry.name}` {', '.join(sizes)}"
            for entry, sizes in zip(graph.input[1:], others, strict=True)
        ]
        multiple, halo = bundle.size_multiple, bundle.halo
        lines.append(
            f"| [{bundle.effect}/{bundle.name}](../models/{bundle.effect}/{bundle.name}/README.md) "
            f"| {', '.join(picture)} | {'; '.join(further)} | {' '.join(bundle.outputs)} | "
            f"{'…' if low is None else f'{low:g}'} to {'any' if high is None else f'{high:g}'} "
            f"| {multiple} | {halo} |"
        )
    return lines


def _inputs(effects: Sequence[Effect]) -> list[str]:
    """What `gbuffer` holds, channel by channel."""
    lines = [
        "| effect | channels of `gbuffer`, from 0 | lengths are divided by | background holds "
        "| its answer | past the picture |",
        "|---|---|---|---|---|---|",
    ]
    for effect in effects:
        rows = [ATTRIBUTES[name] for name in effect.inputs]
        scaled = any(row.unit.scaled for row in rows)
        stays = [f"`{row.name}`" for row in rows if row.in_background]
        on = [f"`{row.name}`" for row in rows if row.goes_on]
        on = ["all"] if len(on) == len(rows) else on
        after = effect.background
        lines.append(
            f"| {effect.name} | {', '.join(f'`{c}`' for row in rows for c in row.channels)} "
            f"| {_LENGTHS[effect.lengths] if scaled else 'has none'} "
            f"| {_list(stays)}{', else ' if stays else ''}0 "
            f"| {_AFTER.get(str(after)) or f'put {after:g}'} "
            f"| {f'repeat {_list(on)}' if on else ''}{', ' if on and on != ['all'] else ''}"
            f"{'' if on == ['all'] else 'else 0' if on else '0'} |"
        )
    return lines


def _operators(bundles: Sequence[Bundle]) -> list[str]:
    """What a runtime must know."""
    lines = ["| bundle | opset | nodes | operators |", "|---|---|---|---|"]
    for bundle in bundles:
        model = _load(bundle)
        names = sorted({node.op_type for node in model.graph.node})
        lines.append(
            f"| {bundle.effect}/{bundle.name} | {model.opset_import[0].version} "
            f"| {len(model.graph.node)} | {', '.join(names)} |"
        )
    return lines


def _list(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _load(bundle: Bundle) -> Any:
    import onnx

    return onnx.load(str(bundle.model), load_external_data=False)


def _dimensions(entry: Any) -> Any:
    return entry.type.tensor_type.shape.dim


def _size(dimension: Any) -> str:
    return dimension.dim_param or str(dimension.dim_value)


if __name__ == "__main__":
    with replacing(PAGE) as part:
        part.write_text(filled(PAGE.read_text("utf-8"), Path("models")), "utf-8")
