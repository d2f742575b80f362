"""OpenVINO on the CPU, in the precisions that the CPU calculates natively.

Three things here are measured rather than obvious:

- In 16 bits the CPU plugin also rounds the arithmetic before the first convolution, such as the
  difference between two large positions (DSSIM + 35 % with bf16 on real views). So the graph is
  split where the bundle says: what comes before runs as a graph of its own in float32, the rest
  in 16 bits, and the tensors between them are handed over without a copy. After the last
  convolution the plugin returns to float32 by itself, but not where it resizes or convolves again:
  where light is blended, the bundle names the tensors from which on a third graph is in float32.
- A graph of fixed size runs up to 1.5 times as fast as one with free height and width, because
  elementwise steps are only fused then, and rounds differently. So every size is compiled when it
  first comes, which takes a few tenths of a second, and kept.
- The plugin keeps a prediction's memory until told otherwise.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from deepshade.bundles import Bundle
from deepshade.engines.base import Backend, Engine, Float
from deepshade.engines.quantising import quantise
from deepshade.engines.splitting import Piece, split
from deepshade.errors import EngineError
from deepshade.extras import install_command
from deepshade.machine import cpu_kind

_CAPABILITIES = {"bf16": "BF16", "int8": "INT8", "fp32": "FP32"}
# How many compiled sizes are kept, and the input pixels for which memory is kept, over all.
MAX_SIZES = 16
MAX_LIVE_PIXELS = 4 * 2**20

Shape = tuple[int, ...]


def precisions(engine: str = "openvino") -> tuple[str, ...]:
    """What this CPU does natively, and rightly. Raises EngineError where OpenVINO isn't installed.

    Not 8 bits with AMX: with 2026.4.1 two of three AO bundles came out 18 and 30 % worse there,
    and none faster than in bf16.
    """
    known = set(_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"))
    if cpu_kind() == "amx":
        known.discard("INT8")
    return tuple(name for name, capability in _CAPABILITIES.items() if capability in known)


class OpenVino(Engine):
    """One bundle, compiled for each size; predictions at the same time follow each other."""

    def __init__(self, bundle: Bundle, backend: Backend, *, threads: int) -> None:
        super().__init__(bundle, backend, threads=threads)
        # What 8 bits leave out runs in the CPU's own 16 bits, if it has them; but where a graph
        # doesn't say what has to be exact, all is.
        in_16_bits = backend.precision != "fp32" and "bf16" in precisions() and bundle.float32
        self._type = "bf16" if in_16_bits else "f32"
        try:
            self._model = _core().read_model(str(bundle.model))
            if backend.precision == "int8":
                quantise(self._model, bundle.int8)
        except RuntimeError as error:
            raise EngineError(f"OpenVINO can't read {bundle.model}: {_reason(error)}") from error
        self._lock = threading.Lock()
        self._compiling = threading.Lock()
        self._networks: dict[Shape, _Network] = {}

    def prepare(self, height: int, width: int) -> None:
        """See `Engine.prepare`."""
        self._network((1, self.bundle.channels, height, width))

    def sizes(self) -> list[tuple[int, int]]:
        """See `Engine.sizes`."""
        with self._lock:
            return list(dict.fromkeys((h, w) for _, _, h, w in self._networks))

    def predict(self, gbuffer: Float, environment: Mapping[str, Float] | None = None) -> Float:
        """See `Engine.predict`."""
        network = self._network(gbuffer.shape)
        shade = network.run(gbuffer, environment or {})
        self._bound(network)
        return shade

    def shrink(self) -> None:
        """See `Engine.shrink`."""
        with self._lock:
            networks = list(self._networks.values())
        for network in networks:
            network.release()

    def _network(self, shape: Shape) -> _Network:
        with self._lock:
            if shape in self._networks:
                return self._networks[shape]
        with self._compiling:  # one at a time: it takes as much memory as a prediction
            with self._lock:
                if shape in self._networks:
                    return self._networks[shape]
            network = self._compile(shape)
            with self._lock:
                if len(self._networks) >= MAX_SIZES:
                    # Were it the oldest, sizes in rotation would be compiled at each use.
                    del self._networks[random.choice(list(self._networks))]
                self._networks[shape] = network
            return network

    def _compile(self, shape: Shape) -> _Network:
        model = self._model.clone()
        try:
            model.reshape({self.bundle.input_name: list(shape)})
            marks = self.bundle.float32, self.bundle.float32_after
            pieces = split(model, *(marks if self._type != "f32" else ()))
            settings = {
                "INFERENCE_NUM_THREADS": self.threads,
                "NUM_STREAMS": 1,
                "ENABLE_CPU_PINNING": False,  # several graphs would be pinned to the same cores
                "CPU_RUNTIME_CACHE_CAPACITY": "0",
            }
            compiled = []
            for piece in pieces:
                hint = {"INFERENCE_PRECISION_HINT": "f32" if piece.exact else self._type}
                graph = _core().compile_model(piece.model, "CPU", settings | hint)
                compiled.append(replace(piece, model=graph))
            return _Network(compiled)
        except RuntimeError as error:
            raise EngineError(
                f"OpenVINO can't compile {self.bundle.effect}/{self.bundle.name} "
                f"in {self.backend.precision}: {_reason(error)}"
            ) from error

    def _bound(self, latest: _Network) -> None:
        """Release the memory of other sizes when together they hold too much."""
        with self._lock:
            others = [network for network in self._networks.values() if network is not latest]
        left = MAX_LIVE_PIXELS - latest.held
        for network in reversed(others):
            left -= network.held
            if left < 0:
                network.release()


class _Network:
    """Compiled graphs that follow each other (see `split`), and requests to run them with."""

    def __init__(self, pieces: list[Piece]) -> None:
        self.held = 0  # the largest prediction, in pixels, whose memory is still taken
        self._pieces = pieces
        self._outputs = int(pieces[-1].model.output(0).get_partial_shape()[1].get_length())
        self._idle: list[list[Any]] = []
        self._lock = threading.Lock()

    def run(self, gbuffer: Float, environment: Mapping[str, Float]) -> Float:
        """(N, C, H, W) to (N, C', H, W)."""
        from openvino import Tensor

        with self._requests() as requests:
            handed = {
                name: Tensor(np.ascontiguousarray(value), shared_memory=True)
                for name, value in environment.items()
            }
            count, _, height, width = gbuffer.shape
            shade = np.empty((count, self._outputs, height, width), np.float32)
            requests[-1].set_output_tensor(0, Tensor(shade, shared_memory=True))
            for piece, request in zip(self._pieces, requests, strict=True):
                # Views, for one picture. They must outlive the prediction.
                views = [np.ascontiguousarray(gbuffer[:, each]) for each in piece.channels]
                given = [Tensor(view, shared_memory=True) for view in views]
                given += [handed[name] for name in piece.taken]
                for index, tensor in enumerate(given):
                    request.set_input_tensor(index, tensor)
                request.infer(share_outputs=True)  # else every tensor is copied for Python
                for index, name in enumerate(piece.gives):
                    handed[name] = request.get_output_tensor(index)
            self.held = max(self.held, gbuffer.size // gbuffer.shape[1])
            return shade

    def release(self) -> None:
        """Give its memory back, unless it is running."""
        if not self.held:
            return
        with self._lock:
            self._idle.clear()
        self.held = 0
        for piece in self._pieces:
            with suppress(RuntimeError):  # busy; it will be asked again
                piece.model.release_memory()

    @contextmanager
    def _requests(self) -> Iterator[list[Any]]:
        with self._lock:
            requests = self._idle.pop() if self._idle else None
        if requests is None:
            requests = [piece.model.create_infer_request() for piece in self._pieces]
        yield requests
        with self._lock:
            self._idle.append(requests)


@cache
def _core() -> Any:
    try:
        from openvino import Core
    except ImportError as error:
        raise EngineError("OpenVINO is not installed", fix=install_command("service")) from error
    return Core()


def _reason(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1][:200] if lines else type(error).__name__
