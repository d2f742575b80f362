"""A program in files: `program.json`, its numbers and weights, and the shaders of a language."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.files import replacing
from deepshade_trainer.shaders.languages import shaders
from deepshade_trainer.shaders.layers import block
from deepshade_trainer.shaders.program import NUMBERS, Program

FORMAT = 1


def write_shaders(
    program: Program, language: str, folder: Path, facts: Mapping[str, Any]
) -> list[Path]:
    """Write a program and its shaders to `folder`; `facts` go into `program.json`.

    `weights.f32` are buffer 0; `passes.i32` holds 64 integers a pass. Of the kernels only those
    that the program runs are written. `program.json` comes last: what it names is whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    used = {each.kernel for each in program.passes}
    texts = {
        name: text
        for name, text in shaders(language).items()
        if Path(name).stem in used or Path(name).stem == "layers"
    }
    for name, text in texts.items():
        with replacing(folder / name) as part:
            part.write_text(text, "utf-8")
    numbers = np.concatenate([each.numbers for each in program.passes])
    for name, array in (("weights.f32", program.weights), ("passes.i32", numbers)):
        with replacing(folder / name) as part:
            array.tofile(part)
    document = {
        "format": FORMAT,
        **facts,
        "inputs": [asdict(slot) for slot in program.inputs],
        "output": asdict(program.output),
        "buffers": program.buffers,
        "numbers": NUMBERS,
        "passes": [
            {
                "kernel": each.kernel,
                "reads": _three(each.sources),
                "writes": each.target,
                "groups": each.groups(block(each)),
            }
            for each in program.passes
        ],
    }
    with replacing(folder / "program.json") as part:
        part.write_text(json.dumps(document, indent=None) + "\n", "utf-8")
    return [folder / name for name in (*texts, "weights.f32", "passes.i32", "program.json")]


def _three(sources: tuple[int, ...]) -> list[int]:
    """What a, b and c are; those that a kernel doesn't read are the first again."""
    return [*sources, *sources[:1] * 3][:3]
