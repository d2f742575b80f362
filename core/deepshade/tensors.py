"""From attributes to what a network is given: order, scale, colour channel, tile, padding.

The service, the trainer and the reports all make their tensors here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import Effect
from deepshade.floats import adjacent

Float = NDArray[np.float32]
Box = tuple[int, int, int, int]  # top, bottom, left, right; the ends are exclusive

# So far away nothing depends on where exactly; what matters is to stay finite, in 16 bits too.
MAX_LENGTH = 6e4
_STEP = 8  # every how many pixels the median depth is taken


@dataclass(frozen=True, slots=True)
class Plane:
    """One channel of a network's input: an (H, W) array, and what to divide it by.

    Past the picture one that `goes_on` repeats its last pixels, any other is 0.
    """

    pixels: Float
    divisor: float | None = None
    goes_on: bool = False


def channel_count(inputs: Iterable[str], per_channel: bool) -> int:
    """The channels of a network's input; one run a colour channel sees one of each colour."""
    return sum(_count(name, per_channel) for name in inputs)


def channel_slices(inputs: Iterable[str], per_channel: bool) -> dict[str, slice]:
    """Where in a network's input each attribute lies."""
    found, start = {}, 0
    for name in inputs:
        stop = start + _count(name, per_channel)
        found[name] = slice(start, stop)
        start = stop
    return found


def length_scale(effect: Effect, attributes: Mapping[str, Float], radius: float) -> float:
    """What an effect's lengths are divided by: `radius`, or the picture's median depth.

    1 where that is wanted and no pixel shows a surface.
    """
    if effect.lengths == "radius":
        return radius
    return median_depth(attributes) or 1.0


def median_depth(attributes: Mapping[str, Float]) -> float | None:
    """The median of "depth" (1, H, W), else of "position" (3, H, W), where it shows a surface.

    Of every eighth pixel each way, if any of those does. None where no surface is shown, or
    neither attribute is there.
    """
    for step in (_STEP, 1):
        if "depth" in attributes:
            depth = attributes["depth"][0, ::step, ::step]
        elif "position" in attributes:
            depth = -attributes["position"][2, ::step, ::step]
        else:
            return None
        depth = depth[np.isfinite(depth) & (depth > 0)]
        if depth.size:
            return float(np.median(depth))
    return None


def planes(
    attributes: Mapping[str, Float],
    inputs: Sequence[str],
    scale: float,
    *,
    channel: int | None = None,
) -> list[Plane]:
    """The channels of a network's input, in its order, not yet scaled.

    `attributes` are (C, H, W) in physical units, `scale` is what lengths are divided by. With a
    `channel` (0 to 2) of each colour only that one is taken: a run for one colour channel.
    """
    found: list[Plane] = []
    for name in inputs:
        attribute, pixels = ATTRIBUTES[name], attributes[name]
        if channel is not None and attribute.coloured:
            pixels = pixels[channel : channel + 1]
        divisor = scale if attribute.unit.scaled and scale != 1 else None
        # Past the picture there is no geometry, but light no darker than what lies beside it.
        found += [Plane(plane, divisor, attribute.goes_on) for plane in pixels]
    return found


def cut(channels: Sequence[Plane], box: Box) -> Float:
    """(1, C, bottom - top, right - left): the box of every channel, scaled, past the picture too.

    No copy where the planes are that already.
    """
    height, width = channels[0].pixels.shape
    top, bottom, left, right = box
    if box == (0, height, 0, width) and not any(plane.divisor for plane in channels):
        block = adjacent([plane.pixels for plane in channels])
        if block is not None:
            return block[None]
    rows, columns = min(bottom, height) - top, min(right, width) - left
    tensor = np.empty((1, len(channels), bottom - top, right - left), np.float32)
    tensor[:, :, rows:, :] = 0
    tensor[:, :, :, columns:] = 0
    for plane, target in zip(channels, tensor[0], strict=True):
        source = plane.pixels[top : top + rows, left : left + columns]
        if plane.divisor is None:
            target[:rows, :columns] = source
        else:
            scale(source, plane.divisor, target[:rows, :columns])
        if plane.goes_on:
            target[:rows, columns:] = target[:rows, columns - 1 : columns]
            target[rows:] = target[rows - 1]
    return tensor


def tensor(
    effect: Effect,
    attributes: Mapping[str, Float],
    inputs: Sequence[str],
    radius: float,
    *,
    per_channel: bool,
    multiple: int = 1,
) -> Float:
    """(N, C, h, w): a whole picture, sides padded to multiples of `multiple`, as `cut` does.

    N is 3 with `per_channel`, one run for each colour channel, else 1.
    """
    by = length_scale(effect, attributes, radius)
    height, width = attributes[inputs[0]].shape[1:]
    box = 0, up(height, multiple), 0, up(width, multiple)
    runs = range(3) if per_channel else (None,)
    return np.concatenate([cut(planes(attributes, inputs, by, channel=run), box) for run in runs])


def scale(source: Float, divisor: float, out: Float) -> None:
    """Lengths `source` (H, W) divided into `out`, so bounded that they stay finite."""
    with np.errstate(over="ignore"):
        np.divide(source, np.float32(divisor), out=out)
    if out.size and (out.max() > MAX_LENGTH or out.min() < -MAX_LENGTH):
        np.clip(out, -MAX_LENGTH, MAX_LENGTH, out=out)


def up(value: int, multiple: int) -> int:
    """`value` rounded up to a multiple."""
    return -(-value // multiple) * multiple


def _count(name: str, per_channel: bool) -> int:
    attribute = ATTRIBUTES[name]
    return 1 if per_channel and attribute.coloured else len(attribute.channels)
