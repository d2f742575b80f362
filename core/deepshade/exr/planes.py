"""A picture that never was a file: planes in memory, read as an EXR of them would be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import floats
from deepshade.exr.chunks import Chunks
from deepshade.exr.header import Header, Part
from deepshade.exr.limits import Limits


@dataclass(frozen=True, slots=True)
class Planes:
    """Channels by name, each (H, W) float16 or float32, C-contiguous, and what a header says.

    `attributes` hold what `Part.attributes` of a file would: numbers, texts, arrays.
    """

    pixels: Mapping[str, NDArray[Any]]
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return sum(plane.nbytes for plane in self.pixels.values())

    def header(self, limits: Limits) -> Header:
        """That of a file of these planes. Raises LimitError."""
        height, width = next(iter(self.pixels.values())).shape
        window = (0, 0, width - 1, height - 1)
        limits.check("pixels", width * height)
        limits.check("channels", len(self.pixels))
        limits.check("decoded_bytes", len(self))
        kinds = {2: "half", 4: "float"}
        part = Part(
            name="",
            channels={name: kinds[plane.itemsize] for name, plane in self.pixels.items()},
            data_window=window,
            display_window=window,
            compression="none",
            attributes=dict(self.attributes),
            decoded_bytes=len(self),
            chunks=Chunks(window, 0, height, 1, None, b""),
        )
        return Header((part,), len(self))

    def fill(self, targets: Mapping[str, NDArray[np.float32]]) -> set[str]:
        """Writes planes as float32 into arrays of their shape; which hold NaN or infinities."""
        nonfinite = set()
        for name, target in targets.items():
            plane = self.pixels[name]
            if plane.dtype == np.float16:
                finite = floats.to_float(plane, target)
            else:
                np.copyto(target, plane)
                finite = floats.is_finite(target)
            if not finite:
                nonfinite.add(name)
        return nonfinite
