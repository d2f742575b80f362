"""One text of every kernel, made a shader of each language: what differs is around it, and words.

Kernels are written in what GLSL and HLSL share: `float value(int i)` makes the i-th number of a
pass from `a(i)`, `b(i)`, `c(i)` (what it reads), `p(k)` and `f(k)` (its numbers, as integer and as
float), `pick(no, yes, which)` and `roundEven`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.resources import files

from deepshade_trainer.shaders.layers import KERNELS, SEVERAL

_HERE = files(__package__)
_WGSL = (
    (r"\bfloat (\w+)\(int (\w+)\) \{", r"fn \1(\2: i32) -> f32 {"),
    (r"\bvoid (\w+)\(int (\w+)\) \{", r"fn \1(\2: i32) {"),
    (r"\b(int|float|bool) (\w+) =", r"var \2: \1 ="),
    (r"\bint\b", "i32"),
    (r"\bfloat\b", "f32"),
    (r"\bpick\(", "select("),
    (r"\broundEven\(", "round("),
)

_ONE = "void run(int i) {\n  if (i < p(0)) { put(i, value(i)); }\n}\n"


def _wgsl(text: str) -> str:
    for pattern, made in _WGSL:
        text = re.sub(pattern, made, text)
    return text


def _hlsl(text: str) -> str:
    return re.sub(r"\broundEven\(", "round(", text)


def _same(text: str) -> str:
    return text


# by language: file ending, host, translation of a kernel
_WAYS: dict[str, tuple[tuple[str, str, Callable[[str], str]], ...]] = {
    "glsl": (("comp", "compute.glsl", _same), ("frag", "fragment.glsl", _same)),
    "wgsl": (("wgsl", "compute.wgsl", _wgsl),),
    "hlsl": (("hlsl", "compute.hlsl", _hlsl),),
}
_FURTHER = {"glsl": ("layers.vert", "layers.geom")}  # what fragment shaders need beside them
LANGUAGES = tuple(_WAYS)


def shaders(language: str) -> dict[str, str]:
    """The texts of all kernels in a language, by the names of their files."""
    made = {}
    for ending, host, translate in _WAYS[language]:
        around = _read("hosts", host)
        for kernel in KERNELS:
            text = _read("kernels", f"{kernel}.txt")
            if host.startswith("compute"):
                text += "\n"
                text += _read("kernels", f"{kernel}.compute.txt") if kernel in SEVERAL else _ONE
            made[f"{kernel}.{ending}"] = around.replace("KERNEL\n", f"{translate(text)}\n")
    return made | {name: _read("hosts", name) for name in _FURTHER.get(language, ())}


def _read(folder: str, name: str) -> str:
    return (_HERE / folder / name).read_text("utf-8")
