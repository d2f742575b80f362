"""Running a bundle's network: set up once, predict often. ONNX Runtime on the CPU."""

from __future__ import annotations

from typing import cast

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade_service.memory import resident

Float = NDArray[np.float32]

_PROBE = 512  # side of the picture that measures the memory per pixel
_FALLBACK_BYTES_PER_PIXEL = 1024


class Engine:
    """One bundle's network on ONNX Runtime, fp32.

    `bytes_per_pixel` is the memory that a prediction needs for each input pixel, measured in
    `warm`. `predict` may be called from several threads at once.
    """

    name = "onnxruntime"
    precision = "fp32"

    def __init__(self, bundle: Bundle, *, threads: int) -> None:
        self.bundle = bundle
        self.channels = sum(len(ATTRIBUTES[name].channels) for name in bundle.inputs)
        self.bytes_per_pixel = _FALLBACK_BYTES_PER_PIXEL
        options = onnxruntime.SessionOptions()
        # ONNX Runtime would count the host's cores, not the container's.
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # The memory pattern is planned per input shape and kept; sizes here are ever different.
        options.enable_mem_pattern = False
        # Without its arena every tensor is mapped and faulted in anew, which costs 15-20 % at
        # 768x512. With it, memory stays taken until it is told otherwise: see `shrink`.
        options.enable_cpu_mem_arena = True
        self._session = onnxruntime.InferenceSession(
            str(bundle.model), options, providers=["CPUExecutionProvider"]
        )
        self._shrinking = onnxruntime.RunOptions()
        self._shrinking.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")

    def warm(self) -> None:
        """Run twice: small, so that weights are laid out; then large, to measure the memory."""
        side = self.bundle.size_multiple
        self.predict(np.zeros((1, self.channels, side, side), np.float32))
        side = max(side, _PROBE // side * side)
        probe = np.zeros((1, self.channels, side, side), np.float32)
        before = resident()
        self.predict(probe)
        used = resident() - before
        if used > 0:
            # At least what goes in and comes out, twice: the reading may be off on a busy start.
            floor = 8 * (self.channels + len(self.bundle.outputs))
            self.bytes_per_pixel = max(floor, round(used / side**2))
        self.shrink()

    def predict(self, gbuffer: Float) -> Float:
        """(N, C, H, W) to (N, C', H, W), H and W multiples of the bundle's size multiple."""
        bundle = self.bundle
        (shade,) = self._session.run([bundle.output_name], {bundle.input_name: gbuffer})
        return cast(Float, shade)

    def shrink(self) -> None:
        """Free the memory that earlier predictions left in the arena."""
        side = self.bundle.size_multiple
        gbuffer = np.zeros((1, self.channels, side, side), np.float32)
        names = [self.bundle.output_name]
        self._session.run(names, {self.bundle.input_name: gbuffer}, self._shrinking)
