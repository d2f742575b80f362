"""Decodes the wanted channels of EXR parts: strip by strip, on several threads."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from deepshade import floats
from deepshade.errors import DamagedImageError
from deepshade.exrheader import Part
from deepshade.threads import run_all, thread_count

Pixels = NDArray[np.float32]

# Bytes decoded at a time, with all the part's channels. Smaller strips take less memory and keep
# more threads busy; but opening the library's file for each takes some 50 µs.
_MOST = 8 * 2**20
_LEAST = 2**20

_TYPES: dict[str, np.dtype[Any]] = {
    "half": np.dtype("<f2"),
    "float": np.dtype("<f4"),
    "uint": np.dtype("<u4"),
}


@dataclass(slots=True)
class Wanted:
    """A part and its wanted channels: name in the part -> C-contiguous (H, W), to be filled.

    Decoding notes in `nonfinite` which of them hold NaN or infinities.
    """

    part: Part
    planes: dict[str, Pixels]
    nonfinite: set[str] = field(default_factory=set)


def decode(data: bytes, wanted: Sequence[Wanted]) -> None:
    """Fills the planes of all the parts that are `wanted` from the bytes of their file.

    Raises DamagedImageError.
    """
    threads = thread_count()
    total = sum(each.part.decoded_bytes for each in wanted)
    piece = min(_MOST, max(_LEAST, -(-total // threads)))
    strips = [
        (each, first, last)
        for each in wanted
        for first, last in _strips(each.part, -(-each.part.decoded_bytes // piece))
    ]
    run_all(lambda strip: _decode(data, *strip), strips, threads)


def _strips(part: Part, count: int) -> list[tuple[int, int]]:
    """`count` runs of the part's rows of chunks, if it has as many and can be cut."""
    rows = part.chunks.rows
    # subsampled lines must not be counted from the top of a strip
    count = 1 if part.subsampled else min(count, rows)
    bounds = [rows * k // count for k in range(count + 1)]
    return list(itertools.pairwise(bounds))


def _decode(data: bytes, wanted: Wanted, first: int, last: int) -> None:
    chunks = wanted.part.chunks
    lines = chunks.lines_of(first, last)
    stored = _uncompressed(data, wanted, first, last)
    if stored is None:
        stored = _by_library(chunks.cut(memoryview(data), first, last))
    for name, plane in wanted.planes.items():
        pixels = stored.get(name)
        if pixels is None or pixels.shape != plane[lines].shape:
            raise DamagedImageError(f"the image is damaged: channel '{name}' is incomplete")
        if not _convert(pixels, plane[lines]):
            wanted.nonfinite.add(name)


def _by_library(data: bytes) -> dict[str, NDArray[Any]]:
    """All the channels of a single-part file, by the OpenEXR library."""
    try:
        # no threads of the library's own: those here decode other strips
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
            found = file.parts[0].channels
            return {name: channel.pixels for name, channel in found.items()}
    except MemoryError:
        raise
    except Exception as error:
        raise DamagedImageError(
            f"the image is damaged: {_reason(error)}", fix="save or send the file again"
        ) from error


def _uncompressed(
    data: bytes, wanted: Wanted, first: int, last: int
) -> dict[str, NDArray[Any]] | None:
    """The wanted channels as they lie in the bytes; None unless they lie there row after row."""
    part, chunks = wanted.part, wanted.part.chunks
    if part.compression != "none" or part.tiled or part.subsampled:
        return None
    if list(part.channels) != sorted(part.channels):  # the library sorts them
        return None
    width, count = part.shape[1], last - first
    types = {name: _TYPES[kind] for name, kind in part.channels.items()}
    head = 8 if chunks.number is None else 12
    size = width * sum(kind.itemsize for kind in types.values())
    table = chunks.table(memoryview(data))[first:last].astype(np.int64)
    if not (table == table[0] + (head + size) * np.arange(count)).all():
        return None
    rows = np.frombuffer(data, np.uint8, count * (head + size), int(table[0]))
    rows = rows.reshape(count, head + size)
    if not (np.ascontiguousarray(rows[:, head - 4 : head]).view("<i4") == size).all():
        return None
    stored: dict[str, NDArray[Any]] = {}
    at = head
    for name, kind in types.items():
        end = at + width * kind.itemsize
        if name in wanted.planes:
            stored[name] = np.ascontiguousarray(rows[:, at:end]).view(kind)
        at = end
    return stored


def _convert(stored: NDArray[Any], plane: Pixels) -> bool:
    """Writes stored pixels of any type to `plane`; whether they are finite."""
    if stored.dtype == np.float16:
        return floats.to_float(stored, plane)
    np.copyto(plane, stored, casting="unsafe")
    return stored.dtype != np.float32 or floats.is_finite(plane)


def _reason(error: Exception) -> str:
    text = str(error).replace('"<python_buffer>"', "").strip()
    return text.splitlines()[0][:200] if text else type(error).__name__
