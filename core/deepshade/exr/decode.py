"""Decodes the wanted channels of EXR parts: strip by strip, on several threads."""

from __future__ import annotations

import io
import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from deepshade import floats
from deepshade.errors import DamagedImageError
from deepshade.exr.header import Part
from deepshade.threads import run_all, thread_count

Pixels = NDArray[np.float32]
Repeats = Mapping[int, Sequence[int]]

# Bytes decoded at a time, with all the part's channels. Smaller strips take less memory and keep
# more threads busy; but opening the library's file for each takes some 50 µs.
MAX_STRIP = 8 * 2**20
MIN_STRIP = 2**20

_TYPES = {"half": "<f2", "float": "<f4", "uint": "<u4"}
_AGAIN = "save or send the file again"


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

    Chunks with the same bytes, as background has, are decoded once. Raises DamagedImageError.
    """
    threads = thread_count()
    distinct = [_distinct(data, each.part) for each in wanted]
    shares = [
        each.part.decoded_bytes * len(rows) // each.part.chunks.rows
        for each, (rows, _) in zip(wanted, distinct, strict=True)
    ]
    piece = min(MAX_STRIP, max(MIN_STRIP, -(-sum(shares) // threads)))
    strips: list[tuple[Wanted, Sequence[int], Repeats]] = []
    for each, (rows, repeats), share in zip(wanted, distinct, shares, strict=True):
        # subsampled lines must not be counted from the top of a strip
        count = 1 if each.part.subsampled else min(-(-share // piece), len(rows))
        bounds = [len(rows) * k // count for k in range(count + 1)]
        strips += [(each, rows[a:b], repeats) for a, b in itertools.pairwise(bounds)]
    run_all(lambda strip: _decode(data, *strip), strips, threads)


def _distinct(data: bytes, part: Part) -> tuple[Sequence[int], Repeats]:
    """(rows of chunks with different bytes, and for each of these the rows that repeat it)."""
    chunks = part.chunks
    every = range(chunks.rows)
    if part.tiled or part.subsampled or part.compression == "none":
        return every, {}
    whole = part.shape[0] // chunks.height  # the last may have fewer scanlines than the others
    view = memoryview(data)
    places = chunks.places(view, 0, whole)
    # most differ in their sizes or last bytes (a checksum in ZIP): only the rest is compared whole
    ends = [(size, data[max(at, at + size - 8) : at + size]) for at, size in places]
    counts = Counter(ends)
    if len(counts) == whole:
        return every, {}
    first: dict[memoryview, int] = {}  # of the bytes, none of which is copied
    repeats: dict[int, list[int]] = {}
    rows: list[int] = []
    for row, (at, size) in enumerate(places):
        source = first.setdefault(view[at : at + size], row) if counts[ends[row]] > 1 else row
        if source == row:
            rows.append(row)
        else:
            repeats.setdefault(source, []).append(row)
    return [*rows, *every[whole:]], repeats


def _runs(rows: Sequence[int]) -> list[range]:
    """Ascending rows as runs of consecutive ones."""
    if rows[-1] - rows[0] < len(rows):
        return [range(rows[0], rows[-1] + 1)]
    runs: list[range] = []
    for row in rows:
        if runs and runs[-1].stop == row:
            runs[-1] = range(runs[-1].start, row + 1)
        else:
            runs.append(range(row, row + 1))
    return runs


def _decode(data: bytes, wanted: Wanted, rows: Sequence[int], repeats: Repeats) -> None:
    """Fills these rows of chunks, and all that repeat one of them."""
    chunks = wanted.part.chunks
    runs = [chunks.lines_of(run.start, run.stop) for run in _runs(rows)]
    height = sum(lines.stop - lines.start for lines in runs)
    copies = [
        (chunks.lines_of(row, row + 1), chunks.lines_of(run.start, run.stop))
        for row in rows
        if row in repeats
        for run in _runs(repeats[row])
    ]
    where = f"scanlines {runs[0].start} to {runs[-1].stop - 1}"
    stored = _uncompressed(data, wanted, rows) or _by_library(
        chunks.cut(memoryview(data), rows), where
    )
    for name, plane in wanted.planes.items():
        pixels = stored.get(name)
        if pixels is None or pixels.shape != (height, plane.shape[1]):
            raise DamagedImageError(f"the image is damaged: channel '{name}' is incomplete")
        top = 0
        for lines in runs:
            bottom = top + lines.stop - lines.start
            if not _convert(pixels[top:bottom], plane[lines]):
                wanted.nonfinite.add(name)
            top = bottom
        for source, target in copies:
            each = plane[source]
            np.copyto(plane[target].reshape(-1, *each.shape), each)


def _by_library(data: bytes, where: str) -> dict[str, NDArray[Any]]:
    """All the channels of a single-part file, by the OpenEXR library; `where` is for errors."""
    try:
        # no threads of the library's own: those here decode other strips
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0) as file:
            if file.parts:
                found = file.parts[0].channels
                return {name: channel.pixels for name, channel in found.items()}
    except MemoryError:
        raise
    except Exception as error:
        text = str(error).replace('"<python_buffer>"', "").strip() or type(error).__name__
        raise DamagedImageError(
            f"the image is damaged within {where}: {text.splitlines()[0][:200]}", fix=_AGAIN
        ) from error
    # the library prints what is wrong, and gives a file without parts
    raise DamagedImageError(
        f"the image is damaged within {where}: pixels can't be decompressed", fix=_AGAIN
    )


def _uncompressed(data: bytes, wanted: Wanted, rows: Sequence[int]) -> dict[str, NDArray[Any]]:
    """The wanted channels, copied out of the bytes; {} unless they lie there row after row."""
    part, chunks = wanted.part, wanted.part.chunks
    if part.compression != "none" or part.tiled or part.subsampled:
        return {}
    if list(part.channels) != sorted(part.channels):  # the library sorts them
        return {}
    names = list(part.channels)
    formats = [(_TYPES[kind], (part.shape[1],)) for kind in part.channels.values()]
    *offsets, step = itertools.accumulate(
        (np.dtype(f).itemsize for f in formats), initial=chunks.head
    )
    places = chunks.places(memoryview(data), rows[0], rows[-1] + 1)
    start = places[0][0]
    if places != [(start + n * step, step - chunks.head) for n in range(len(places))]:
        return {}
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    lines = np.frombuffer(data, layout, len(places), start - chunks.head)
    return {name: np.ascontiguousarray(lines[name]) for name in wanted.planes}


def _convert(stored: NDArray[Any], plane: Pixels) -> bool:
    """Writes stored pixels of any type to `plane`; whether they are finite."""
    if stored.dtype == np.float16:
        return floats.to_float(stored, plane)
    np.copyto(plane, stored, casting="unsafe")
    return stored.dtype != np.float32 or floats.is_finite(plane)
