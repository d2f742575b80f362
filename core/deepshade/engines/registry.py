"""Which backends there are, which of them this machine has, and how to get the others."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Protocol, cast

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine
from deepshade.errors import EngineError, nearest

# What every machine with the service has, and what the others are measured against.
REFERENCE = Backend("onnxruntime", "fp32")

_CPU = ("fp32", "bf16", "fp16", "int8")
# engine -> (module, the precisions that it could have somewhere)
_ENGINES: dict[str, tuple[str, tuple[str, ...]]] = {
    "onnxruntime": ("deepshade.engines.onnx", ("fp32", "int8")),
    "openvino": ("deepshade.engines.openvino", _CPU),
    "cuda": ("deepshade.engines.onnx", ("fp32",)),
    "tensorrt": ("deepshade.engines.onnx", ("fp32", "fp16")),
}


class _Module(Protocol):
    def precisions(self, engine: str) -> tuple[str, ...]:
        """What `engine` can do on this machine; raises EngineError if it is not here at all."""

    def load(self, bundle: Bundle, backend: Backend, threads: int) -> Engine:
        """The engine, not yet warm."""


def known() -> list[Backend]:
    """Every backend that deepshade can use, on whatever machine."""
    return [Backend(engine, one) for engine, (_, all_) in _ENGINES.items() for one in all_]


@cache
def available() -> tuple[Backend, ...]:
    """The backends that run on this machine, `REFERENCE` first if it is one of them."""
    found: list[Backend] = []
    for engine in _ENGINES:
        try:
            found += [
                Backend(engine, precision) for precision in _module(engine).precisions(engine)
            ]
        except EngineError:
            continue
    return tuple(found)


def load_engine(bundle: Bundle, backend: Backend, *, threads: int) -> Engine:
    """The bundle's network on that backend; call `warm` before timing it.

    Raises EngineError: there is no such backend, this machine lacks it (and what to install), the
    bundle has no file for it, or the library refuses the graph.
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
    if backend.precision == "int8" and bundle.int8 is None:
        raise EngineError(
            f"the bundle {bundle.effect}/{bundle.name} has no int8 graph",
            fix="export it again, or choose another precision",
        )
    return _module(backend.engine).load(bundle, backend, threads)


def usable(bundle: Bundle) -> list[Backend]:
    """`available`, less what this bundle has no file for."""
    return [one for one in available() if one.precision != "int8" or bundle.int8 is not None]


def _module(engine: str) -> _Module:
    return cast(_Module, import_module(_ENGINES[engine][0]))
