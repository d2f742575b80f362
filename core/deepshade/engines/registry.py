"""Which backends there are, which of them this machine has, and which one is used."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine
from deepshade.errors import EngineError, nearest
from deepshade.extras import install_command
from deepshade.machine import cpu_kind

# What every machine with the service has, and what the others are measured against.
REFERENCE = Backend("onnxruntime", "fp32")

# engine -> its module and class; the engine that is used first, by rule, comes first
_ENGINES = {
    "cuda": ("deepshade.engines.onnxruntime", "OnnxRuntime"),
    "openvino": ("deepshade.engines.openvino", "OpenVino"),
    "onnxruntime": ("deepshade.engines.onnxruntime", "OnnxRuntime"),
}


@cache
def available() -> tuple[Backend, ...]:
    """The backends of this machine, in the order of the rule that chooses among them."""
    found: list[Backend] = []
    for engine in _ENGINES:
        try:
            found += [Backend(engine, one) for one in _module(engine).precisions(engine)]
        except EngineError:
            continue
    return tuple(found)


def usable(bundle: Bundle) -> list[Backend]:
    """`available`, less 8 bits where the bundle has no ranges for them, and less all but float32
    where it bears no other."""
    return [
        one
        for one in available()
        if one.precision == "fp32"
        or not (bundle.exact or (one.precision == "int8" and not bundle.int8))
    ]


def choose(bundle: Bundle, engine: str | None = None, precision: str | None = None) -> Backend:
    """The backend that a bundle runs on here: the first of the rule that is as asked.

    CUDA where there is a GPU, else OpenVINO, else ONNX Runtime; bf16 where the CPU calculates in
    it, else 8 bits where the bundle was found to lose little by them on this kind of CPU, else
    fp32. The rule looks at the machine and the bundle alone, so a request gets the same bytes
    always. Raises EngineError if none is as asked.
    """
    for backend in usable(bundle):
        unproven = backend.precision == "int8" and cpu_kind() not in bundle.int8_kinds
        if engine not in (None, backend.engine) or precision not in (None, backend.precision):
            continue
        if not unproven or precision == "int8":
            return backend
    asked = "/".join(part or "*" for part in (engine, precision))
    here = ", ".join(map(str, usable(bundle)))
    raise EngineError(
        f"no '{asked[:100]}' for this bundle on this machine" if here else "no engine is installed",
        fix=f"one of: {here}" if here else install_command("service"),
    )


def load_engine(bundle: Bundle, backend: Backend, *, threads: int) -> Engine:
    """The bundle's network on that backend; call `warm` before timing it.

    Raises EngineError: there is no such backend, this machine lacks it (and what to install), or
    the library refuses the graph.
    """
    if backend.engine not in _ENGINES:
        near = nearest(backend.engine, _ENGINES)
        raise EngineError(
            f"there is no engine '{backend.engine}'",
            fix=f"did you mean '{near}'?" if near else f"one of: {', '.join(_ENGINES)}",
        )
    precisions = _module(backend.engine).precisions(backend.engine)
    if backend.precision not in precisions:
        raise EngineError(
            f"'{backend.engine}' has no precision '{backend.precision}' on this machine",
            fix=f"one of: {', '.join(precisions)}",
        )
    if backend.precision == "int8" and not bundle.int8:
        raise EngineError(
            f"the bundle {bundle.effect}/{bundle.name} has no ranges for 8 bits",
            fix="export it again, or choose another precision",
        )
    kind = getattr(_module(backend.engine), _ENGINES[backend.engine][1])
    engine: Engine = kind(bundle, backend, threads=threads)
    return engine


def _module(engine: str) -> Any:
    return import_module(_ENGINES[engine][0])
