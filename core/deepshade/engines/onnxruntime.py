"""ONNX Runtime: on the CPU, and by its CUDA provider where that is installed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, cast

import numpy as np

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine, Float
from deepshade.environments import black
from deepshade.errors import EngineError
from deepshade.extras import install_command

_PROVIDERS = {"onnxruntime": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}


def precisions(engine: str) -> tuple[str, ...]:
    """("fp32",). Raises EngineError where the engine isn't installed or has no device."""
    if _PROVIDERS[engine] not in _runtime().get_available_providers():
        raise EngineError(
            f"this ONNX Runtime has no {_PROVIDERS[engine]}",
            fix="pip uninstall onnxruntime, then pip install onnxruntime-gpu",
        )
    if engine == "cuda" and not _has_gpu():
        raise EngineError("this machine has no NVIDIA GPU that ONNX Runtime can use")
    return ("fp32",)


class OnnxRuntime(Engine):
    """One bundle in one session; predictions at the same time share its threads."""

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        super().__init__(bundle, backend, threads=threads)
        self._session = _open(str(bundle.model), backend.engine, threads)
        self._shrinking = _runtime().RunOptions()
        self._shrinking.add_run_config_entry(
            "memory.enable_memory_arena_shrinkage",
            "cpu:0;gpu:0" if backend.engine == "cuda" else "cpu:0",
        )

    def predict(self, gbuffer: Float, environment: Mapping[str, Float] | None = None) -> Float:
        """See `Engine.predict`."""
        return self._run(gbuffer, environment or {})

    def shrink(self) -> None:
        """See `Engine.shrink`."""
        side = self.bundle.size_multiple
        picture = np.zeros((1, self.bundle.channels, side, side), np.float32)
        self._run(picture, black(self.bundle.environment), self._shrinking)

    def _run(self, gbuffer: Float, environment: Mapping[str, Float], options: Any = None) -> Float:
        given = {self.bundle.input_name: gbuffer, **environment}
        (shade,) = self._session.run([self.bundle.output_name], given, options)
        return cast(Float, shade)


def _open(graph: str, engine: str, threads: int) -> Any:
    runtime = _runtime()
    options = runtime.SessionOptions()
    # ONNX Runtime would count the host's cores, not the container's.
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Threads that spin while they wait take the CPU from whoever else is shading.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # The memory pattern is planned per input shape and kept; sizes here are ever different.
    options.enable_mem_pattern = False
    # To plan which tensors share memory takes time by the square of the graph's length, 20 s for
    # 3,500 nodes, and the arena shares it anyway.
    options.enable_mem_reuse = False
    # Without its arena every tensor is mapped and faulted in anew, which costs 15-20 % at
    # 768x512. With it, memory stays taken until it is told otherwise: see `shrink`.
    options.enable_cpu_mem_arena = True
    options.log_severity_level = 3  # what it can't do raises; the rest is advice
    provider: Any = _PROVIDERS[engine]
    if engine == "cuda":
        provider = (provider, {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"})
    try:
        session = runtime.InferenceSession(graph, options, providers=[provider])
    except Exception as error:  # its own types derive from nothing more telling
        raise EngineError(f"ONNX Runtime can't load {graph}: {error!s:.200}") from error
    if _PROVIDERS[engine] not in session.get_providers():  # it falls back without an error
        raise EngineError(
            f"ONNX Runtime can't use its {_PROVIDERS[engine]}",
            fix="install the CUDA and cuDNN version that this ONNX Runtime needs",
        )
    return session


@cache
def _runtime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise EngineError(
            "ONNX Runtime is not installed", fix=install_command("service")
        ) from error
    return onnxruntime


@cache
def _has_gpu() -> bool:
    """Whether NVIDIA's driver finds a device: ONNX Runtime's GPU build installs without one too."""
    import ctypes
    import sys

    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return (
        driver.cuInit(0) == 0
        and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
        and count.value > 0
    )
