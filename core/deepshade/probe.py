"""A bundle's probe: a few held-out G-buffers with their references, in one EXR.

Square windows lie one below the other. The inputs have their canonical channels, positions in
units of the effect radius, and the layer `reference_<effect>` is the answer. On these a machine
measures what a precision costs a bundle.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, metrics
from deepshade.attributes import ATTRIBUTES
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import BundleError

if TYPE_CHECKING:
    from deepshade.engines import Engine

Image = NDArray[np.float32]
# (C, S, S) in network order and (outputs, S, S)
Window = tuple[Image, Image]


def write_probe(path: Path, effect: str, windows: Sequence[Window]) -> None:
    """Write windows, all of one size.

    24-bit positions resolve 1.5e-5 of their value and pack well; the rest, within [-1, 1] or so,
    is stored in 16.
    """
    inputs, outputs = _channels(effect)
    planes = np.concatenate([gbuffer for gbuffer, _ in windows], axis=1)
    references = np.concatenate([reference for _, reference in windows], axis=1)
    channels = dict(zip(inputs, planes, strict=True))
    channels |= dict(zip(outputs, references, strict=True))
    points = {c for name in EFFECTS[effect].inputs for c in _full(name)}
    attributes = {"deepshade:radius": 1.0, "deepshade:effect": effect}
    half = [name for name in channels if name not in points]
    exr.write(path, channels, attributes=attributes, compression="pxr24", half=half)


def read_probe(bundle: Bundle) -> list[Window]:
    """The bundle's windows; [] if it has no probe. Raises BundleError if they don't fit it."""
    if bundle.probe is None:
        return []
    inputs, outputs = _channels(bundle.effect)
    image = exr.read(bundle.probe, [*inputs, *outputs])
    planes, references = image.stack(inputs), image.stack(outputs)
    height, side = planes.shape[1:]
    if height % side or side % bundle.size_multiple:
        raise BundleError(
            f"{bundle.probe} is {side} x {height}, no column of squares of whole multiples of "
            f"{bundle.size_multiple}",
            fix="export the bundle again",
        )
    return [
        (planes[:, top : top + side], references[:, top : top + side])
        for top in range(0, height, side)
    ]


def dssim(engine: Engine, windows: Sequence[Window]) -> float:
    """An engine's mean DSSIM over a probe."""
    errors = []
    for gbuffer, reference in windows:
        shade = engine.predict(np.ascontiguousarray(gbuffer)[None])[0]
        errors.append(metrics.dssim(np.clip(shade, 0, 1), np.clip(reference, 0, 1)))
    return float(np.mean(errors))


def _channels(effect: str) -> tuple[list[str], list[str]]:
    """The EXR channels of the inputs, in network order, and those of the reference."""
    row = EFFECTS[effect]
    layer = f"reference_{effect}"
    count = 1 if row.per_channel else len(row.outputs)
    outputs = [f"{layer}.V"] if count == 1 else [f"{layer}.{band}" for band in "RGB"]
    inputs: list[str] = []
    for name in row.inputs:
        attribute = ATTRIBUTES[name]
        single = row.per_channel and attribute.kind == "colour"
        inputs += attribute.channels[:1] if single else attribute.channels
    return inputs, outputs


def _full(name: str) -> tuple[str, ...]:
    """The channels of an attribute that 16 bits would not resolve, or not hold."""
    attribute = ATTRIBUTES[name]
    return () if attribute.kind in ("vector", "motion") else attribute.channels
