"""OpenVINO on the CPU, in the precisions that the CPU calculates natively.

Three things here are measured rather than obvious:

- In 16 bits the CPU plugin also rounds the arithmetic before the first convolution, such as the
  difference between two large positions (DSSIM + 35 % with bf16 on real views). So the graph is
  cut there: what comes before runs as a graph of its own in float32, the rest in 16 bits, and the
  tensors between them are handed over without a copy. After the last convolution the plugin
  returns to float32 by itself.
- A graph of fixed size runs up to 1.5 times as fast as one with free height and width, because
  elementwise steps are only fused then. But it takes a tenth of a second or more to compile. So a
  size runs on the free graph until it has come several times, and then, as soon as that is
  compiled in the background, on one of a few fixed ones.
- The plugin keeps what it prepared for every size it has seen, without end, unless its cache is
  off, and keeps a prediction's memory until told otherwise.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any

import numpy as np

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine, Float
from deepshade.engines.cutting import cut, whole
from deepshade.errors import EngineError
from deepshade.machine import cpu_kind

_TYPES = {"fp32": "f32", "bf16": "bf16", "fp16": "f16"}
_CAPABILITIES = {"fp32": "FP32", "bf16": "BF16", "fp16": "FP16", "int8": "INT8"}
# After how many predictions a size is compiled, how many of them are kept, and the input pixels
# for which memory is kept, over all of them.
_OFTEN = 4
_SIZES = 12
_LIVE_PIXELS = 4 * 2**20
# Compiling takes as much memory as a prediction. For sizes above so many pixels it waits until
# nothing has run for `_QUIET` seconds, but no longer than `_PATIENCE`.
_LARGE = 2**20
_QUIET, _PATIENCE = 0.1, 5.0

Shape = tuple[int, ...]


def precisions(engine: str = "openvino") -> tuple[str, ...]:
    """What this CPU does natively, and rightly. Raises EngineError where OpenVINO isn't installed.

    Not 8 bits with AMX: on graphs of free size they may crash there (issue 37577 of
    openvinotoolkit/openvino), and with 2026.4.1 our bundles came out up to 30 % worse.
    """
    known = set(_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"))
    if cpu_kind() == "amx":
        known.discard("INT8")
    return tuple(name for name, capability in _CAPABILITIES.items() if capability in known)


def load(bundle: Bundle, backend: Backend, threads: int) -> Engine:
    """See `deepshade.engines.load_engine`."""
    return OpenVino(bundle, backend, threads=threads)


class OpenVino(Engine):
    """One bundle on OpenVINO. With n > 1 predictions at once each runs on threads/n threads."""

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        super().__init__(bundle, backend, threads=threads)
        graph = bundle.model
        self._type = _TYPES.get(backend.precision, "f32")
        if backend.precision == "int8" and bundle.int8 is not None:
            graph = bundle.int8
            # What isn't quantised runs in the CPU's own 16 bits, if it has them.
            self._type = "bf16" if "bf16" in precisions() else "f32"
        try:
            self._model = _core().read_model(str(graph))
        except RuntimeError as error:
            raise EngineError(f"OpenVINO can't read {graph}: {_reason(error)}") from error
        self._lock = threading.Lock()
        self._free: dict[int, _Network] = {}  # by threads of a prediction
        self._fixed: OrderedDict[tuple[Shape, int], _Network] = OrderedDict()
        self._seen: OrderedDict[tuple[Shape, int], int] = OrderedDict()  # how often
        self._pending: dict[tuple[Shape, int], Future[None]] = {}
        self._running = 0
        self._ended = 0.0  # when the last prediction did
        self._network(None, threads)

    def prepare(self, height: int, width: int) -> None:
        """See `Engine.prepare`."""
        self._fix(((1, self.channels, height, width), self.threads))

    def shrink(self) -> None:
        """See `Engine.shrink`."""
        with self._lock:
            networks = [*self._free.values(), *self._fixed.values()]
        for network in networks:
            network.release()

    def _run(self, gbuffer: Float, threads: int) -> Float:
        key = (gbuffer.shape, threads)
        with self._lock:
            network = self._fixed.get(key)
            if network is not None:
                self._fixed.move_to_end(key)
            else:
                self._seen[key] = self._seen.pop(key, 0) + 1
                if self._seen[key] >= _OFTEN and key not in self._pending:
                    self._pending[key] = _background.submit(self._fix_later, key)
                if len(self._seen) > 64:
                    self._seen.popitem(last=False)
            self._running += 1
        try:
            if network is None:
                network = self._network(None, threads)
            shade = network.run(gbuffer)
        finally:
            with self._lock:
                self._running -= 1
                self._ended = time.monotonic()
        self._bound(network)
        return shade

    def _fix_later(self, key: tuple[Shape, int]) -> None:
        """`_fix`, for a large size when nothing runs."""
        latest = time.monotonic() + (_PATIENCE if _large(key[0]) else 0)
        while time.monotonic() < latest:
            if not self._running and time.monotonic() - self._ended > _QUIET:
                break
            time.sleep(_QUIET / 2)
        self._fix(key)

    def _fix(self, key: tuple[Shape, int]) -> None:
        """Compile a size. One that fails stays on the free graph, and isn't tried again."""
        shape, threads = key
        with self._lock:
            if key in self._fixed:
                return
        network = self._compile(shape, threads)
        if _large(shape):
            # The plugin has already taken what a prediction needs, and can't give it back before.
            network.run(np.zeros(shape, np.float32))
            network.release()
        with self._lock:
            self._fixed[key] = network
            if len(self._fixed) > _SIZES:
                self._fixed.popitem(last=False)
            self._pending.pop(key, None)
            free = self._free.get(threads)
        if free is not None:
            free.release()  # it won't be needed for this size again

    def _network(self, shape: Shape | None, threads: int) -> _Network:
        with self._lock:
            if threads not in self._free:
                self._free[threads] = self._compile(shape, threads)
            return self._free[threads]

    def _compile(self, shape: Shape | None, threads: int) -> _Network:
        model = self._model.clone()
        try:
            if shape is not None:
                model.reshape(list(shape))
            pieces = whole(model) if self._type == "f32" else cut(model)
            settings = {
                "INFERENCE_NUM_THREADS": self.threads,
                "NUM_STREAMS": max(1, self.threads // threads),
                "ENABLE_CPU_PINNING": False,  # several graphs would be pinned to the same cores
                "CPU_RUNTIME_CACHE_CAPACITY": "0",
            }
            types = ["f32" if piece.exact else self._type for piece in pieces]
            graphs = [
                _core().compile_model(
                    piece.model, "CPU", {**settings, "INFERENCE_PRECISION_HINT": kind}
                )
                for piece, kind in zip(pieces, types, strict=True)
            ]
            return _Network(graphs, [piece.channels for piece in pieces])
        except RuntimeError as error:
            raise EngineError(
                f"OpenVINO can't compile {self.bundle.effect}/{self.bundle.name} "
                f"in {self.backend.precision}: {_reason(error)}"
            ) from error

    def _bound(self, latest: _Network) -> None:
        """Release the memory of other sizes when together they hold too much."""
        with self._lock:
            others = [n for n in (*self._free.values(), *self._fixed.values()) if n is not latest]
        room = _LIVE_PIXELS - latest.held
        for network in reversed(others):
            room -= network.held
            if room < 0:
                network.release()


class _Network:
    """One compiled graph, or two that follow each other, and requests to run them with.

    Of each graph the first inputs are these `channels` of the picture (see `cut`), and the others
    what the graph before it puts out.
    """

    def __init__(self, graphs: list[Any], channels: list[tuple[slice, ...]]) -> None:
        self.held = 0  # the largest prediction, in pixels, whose memory is still taken
        self._graphs = graphs
        self._channels = channels
        self._outputs = int(graphs[-1].output(0).get_partial_shape()[1].get_length())
        self._idle: list[list[Any]] = []
        self._lock = threading.Lock()

    def run(self, gbuffer: Float) -> Float:
        """(N, C, H, W) to (N, C', H, W)."""
        from openvino import Tensor

        with self._requests() as requests:
            handed: list[Any] = []
            count, _, height, width = gbuffer.shape
            shade = np.empty((count, self._outputs, height, width), np.float32)
            requests[-1].set_output_tensor(0, Tensor(shade, shared_memory=True))
            for graph, channels, request in zip(
                self._graphs, self._channels, requests, strict=True
            ):
                # Views, for one picture. They must outlive the prediction.
                views = [np.ascontiguousarray(gbuffer[:, each]) for each in channels]
                given = [Tensor(view, shared_memory=True) for view in views]
                for index, tensor in enumerate([*given, *handed]):
                    request.set_input_tensor(index, tensor)
                request.infer(share_outputs=True)  # else every tensor is copied for Python
                handed = [request.get_output_tensor(k) for k in range(len(graph.outputs))]
            self.held = max(self.held, gbuffer.size // gbuffer.shape[1])
            return shade

    def release(self) -> None:
        """Give its memory back, unless it is running."""
        if not self.held:
            return
        with self._lock:
            self._idle.clear()
        self.held = 0
        for graph in self._graphs:
            with suppress(RuntimeError):  # busy; it will be asked again
                graph.release_memory()

    @contextmanager
    def _requests(self) -> Iterator[list[Any]]:
        with self._lock:
            requests = self._idle.pop() if self._idle else None
        if requests is None:
            requests = [graph.create_infer_request() for graph in self._graphs]
        yield requests
        with self._lock:
            self._idle.append(requests)


def _large(shape: Shape) -> bool:
    return shape[2] * shape[3] > _LARGE


# One at a time, so that compiling never takes more than one core from what is being shaded.
_background = ThreadPoolExecutor(1, thread_name_prefix="compile")


@cache
def _core() -> Any:
    try:
        from openvino import Core
    except ImportError as error:
        raise EngineError(
            "OpenVINO is not installed", fix="pip install 'deepshade[service]' or openvino"
        ) from error
    return Core()


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
