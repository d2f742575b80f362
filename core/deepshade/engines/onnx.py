"""ONNX Runtime: on the CPU, and by its CUDA and TensorRT providers where they are installed."""

from __future__ import annotations

import threading
import time
from functools import cache
from typing import Any, cast

import numpy as np

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine, Float
from deepshade.errors import EngineError

_PROVIDERS = {
    "onnxruntime": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
_PRECISIONS = {
    "onnxruntime": ("fp32", "int8"),
    "cuda": ("fp32",),
    "tensorrt": ("fp32", "fp16"),
}


def precisions(engine: str) -> tuple[str, ...]:
    """What the engine can do here. Raises EngineError where it isn't installed or has no device."""
    if _PROVIDERS[engine] not in _runtime().get_available_providers():
        raise EngineError(
            f"this ONNX Runtime has no {_PROVIDERS[engine]}",
            fix="pip uninstall onnxruntime, then pip install onnxruntime-gpu",
        )
    if engine != "onnxruntime" and not _has_gpu():
        raise EngineError("this machine has no NVIDIA GPU that ONNX Runtime can use")
    return _PRECISIONS[engine]


def load(bundle: Bundle, backend: Backend, threads: int) -> Engine:
    """See `deepshade.engines.load_engine`."""
    return OnnxRuntime(bundle, backend, threads=threads)


class OnnxRuntime(Engine):
    """One bundle on ONNX Runtime. With n > 1 predictions at once each runs on threads/n threads."""

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        super().__init__(bundle, backend, threads=threads)
        int8 = backend.precision == "int8" and bundle.int8 is not None
        self._graph = str(bundle.int8 if int8 else bundle.model)
        self._lock = threading.Lock()
        self._sessions: dict[int, Any] = {}
        self._session(threads)
        self._shrinking = _runtime().RunOptions()
        on_cpu = backend.engine == "onnxruntime"
        self._shrinking.add_run_config_entry(
            "memory.enable_memory_arena_shrinkage", "cpu:0" if on_cpu else "cpu:0;gpu:0"
        )

    def _run(self, gbuffer: Float, threads: int) -> Float:
        names = [self.bundle.output_name]
        (shade,) = self._session(threads).run(names, {self.bundle.input_name: gbuffer})
        return cast(Float, shade)

    def device_ms(self, gbuffer: Float, runs: int = 20) -> float | None:
        """See `Engine.device_ms`."""
        device = "cpu" if self.backend.engine == "onnxruntime" else "cuda"
        session = self._session(self.threads)
        binding = session.io_binding()
        given = _runtime().OrtValue.ortvalue_from_numpy(gbuffer, device, 0)
        binding.bind_ortvalue_input(self.bundle.input_name, given)
        binding.bind_output(self.bundle.output_name, device, 0)
        taken = []
        for _ in range(runs + 3):
            start = time.perf_counter()
            session.run_with_iobinding(binding)
            binding.synchronize_outputs()
            taken.append(1e3 * (time.perf_counter() - start))
        return float(np.median(taken[3:]))

    def shrink(self) -> None:
        """See `Engine.shrink`."""
        side = self.bundle.size_multiple
        gbuffer = np.zeros((1, self.channels, side, side), np.float32)
        names = [self.bundle.output_name]
        with self._lock:
            sessions = list(self._sessions.values())
        for session in sessions:
            session.run(names, {self.bundle.input_name: gbuffer}, self._shrinking)

    def _session(self, threads: int) -> Any:
        with self._lock:
            if threads not in self._sessions:
                self._sessions[threads] = self._open(threads)
            return self._sessions[threads]

    def _open(self, threads: int) -> Any:
        runtime = _runtime()
        options = runtime.SessionOptions()
        # ONNX Runtime would count the host's cores, not the container's.
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Threads that spin while they wait take the CPU from whoever else is shading.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # The memory pattern is planned per input shape and kept; sizes here are ever different.
        options.enable_mem_pattern = False
        # Without its arena every tensor is mapped and faulted in anew, which costs 15-20 % at
        # 768x512. With it, memory stays taken until it is told otherwise: see `shrink`.
        options.enable_cpu_mem_arena = True
        options.log_severity_level = 3  # what it can't do raises; the rest is advice
        try:
            session = runtime.InferenceSession(
                self._graph, options, providers=_providers(self.backend)
            )
        except Exception as error:  # its own types derive from nothing more telling
            raise EngineError(f"ONNX Runtime can't load {self._graph}: {error!s:.200}") from error
        provider = _PROVIDERS[self.backend.engine]
        if provider not in session.get_providers():  # it falls back to others without an error
            raise EngineError(
                f"ONNX Runtime can't use its {provider}",
                fix="install the CUDA, cuDNN or TensorRT version that this ONNX Runtime needs",
            )
        return session


def _providers(backend: Backend) -> list[Any]:
    if backend.engine == "onnxruntime":
        return [_PROVIDERS["onnxruntime"]]
    cuda = (_PROVIDERS["cuda"], {"use_tf32": "0", "cudnn_conv_algo_search": "HEURISTIC"})
    if backend.engine == "cuda":
        return [cuda]
    settings = {"trt_fp16_enable": str(backend.precision == "fp16")}
    return [(_PROVIDERS["tensorrt"], settings), cuda]


@cache
def _runtime() -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise EngineError(
            "ONNX Runtime is not installed", fix="pip install 'deepshade[service]'"
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
