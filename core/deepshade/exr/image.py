"""Reads and writes OpenEXR images; nothing outside this and `decode` knows the library."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray

from deepshade import floats
from deepshade.errors import ImageError
from deepshade.exr import encode as exrencode
from deepshade.exr.chunks import Window
from deepshade.exr.decode import Wanted, decode
from deepshade.exr.entries import Entry
from deepshade.exr.header import MAX_COORDINATE, WRITABLE, Header, parse
from deepshade.exr.limits import Limits
from deepshade.exr.planes import Planes
from deepshade.files import replacing
from deepshade.threads import thread_count

Pixels = NDArray[np.float32]

COMPRESSIONS = {
    name: getattr(OpenEXR, f"{name.replace('none', 'no').upper()}_COMPRESSION") for name in WRITABLE
}

_pool_owner = 0  # the process that started the library's threads


@dataclass(frozen=True, slots=True)
class Image:
    """Decoded pixels: name in `header.channels()` -> (H, W) float32, C-contiguous.

    `nonfinite` names the channels that hold NaN or infinities.
    """

    header: Header
    pixels: dict[str, Pixels]
    nonfinite: frozenset[str] = frozenset()

    def stack(self, names: Sequence[str]) -> Pixels:
        """Channels as one (C, H, W) array; no copy when they were read in this order."""
        planes = [self.pixels[name] for name in names]
        block = floats.adjacent(planes)
        return np.stack(planes) if block is None else block


def read_header(source: Path | str | bytes | Planes, limits: Limits | None = None) -> Header:
    """The checked header of an EXR file, of its bytes, or of planes; no pixel is decoded.

    Limits, windows, and whether every chunk really lies in the file are checked here.
    Raises ImageError, DamagedImageError, LimitError.
    """
    limits = limits or Limits()
    if isinstance(source, Planes):
        return source.header(limits)
    return parse(memoryview(fetch(source, limits)), limits)


def read(
    source: Path | str | bytes | Planes,
    channels: Collection[str] | None = None,
    limits: Limits | None = None,
    *,
    header: Header | None = None,
) -> Image:
    """Decodes an EXR file, its bytes, or planes into float32 (half and uint are converted).

    `channels` selects, and orders in memory, the wanted ones by their `Header.channels()`
    names; None is all. Parts with none of them are not decoded, and of the others only a strip at
    a time is ever there with all its channels. `header` is what `read_header` gave for the same
    bytes, to spare reading it again. Raises ImageError, DamagedImageError, LimitError.
    """
    limits = limits or Limits()
    data = source if isinstance(source, Planes) else fetch(source, limits)
    header = header or read_header(data, limits)
    places = header.channels()
    wanted = list(places) if channels is None else list(dict.fromkeys(channels))
    for name in wanted:
        if name not in places:
            raise ImageError(f"there is no channel '{name}'; found: {', '.join(places)}")
        index, channel = places[name]
        if channel in header.parts[index].subsampled:
            raise ImageError(
                f"channel '{name}' is subsampled (luminance/chroma)",
                fix="save every channel at full resolution, for example as R G B",
            )
    # planes of one shape lie one after the other in memory, so that `stack` need not copy them
    shapes = {name: header.parts[places[name][0]].shape for name in wanted}
    blocks = {
        shape: iter(np.empty((count, *shape), np.float32))
        for shape, count in Counter(shapes.values()).items()
    }
    pixels = {name: next(blocks[shape]) for name, shape in shapes.items()}
    if isinstance(data, Planes):
        return Image(header, pixels, frozenset(data.fill(pixels)))
    jobs: dict[int, Wanted] = {}
    for name in wanted:
        index, channel = places[name]
        job = jobs.setdefault(index, Wanted(header.parts[index], {}))
        job.planes[channel] = pixels[name]
    decode(data, list(jobs.values()))
    nonfinite = {name for name in wanted if places[name][1] in jobs[places[name][0]].nonfinite}
    return Image(header, pixels, frozenset(nonfinite))


def write(
    target: Path | str | BinaryIO,
    channels: Mapping[str, ArrayLike],
    *,
    attributes: Mapping[str, Any] | None = None,
    compression: str = "zip",
    half: bool | Collection[str] = False,
    data_window: Window | None = None,
    display_window: Window | None = None,
) -> None:
    """Writes a single-part scanline EXR.

    `channels` maps names to (H, W) arrays, all of one size. `half` says which of them are
    stored in 16 bits: all, none, or those named; finite values beyond ±65504 are clamped there
    rather than turned into infinities. Windows are (x0, y0, x1, y1), inclusive: where the pixels
    lie, and the whole frame; each begins at (0, 0) and has the image's size by default.
    `attributes` are numbers, strings, 2- or 3-vectors, 3x3 or 4x4 matrices, and entries of another
    file; an integer beyond 32 bits is stored as text. A path is replaced atomically: written
    beside, synced, renamed.
    Raises ValueError for arrays or settings that no EXR can hold.
    """
    if compression not in COMPRESSIONS:
        raise ValueError(f"unknown compression '{compression}', one of: {', '.join(COMPRESSIONS)}")
    if not channels:
        raise ValueError("an image needs at least one channel")
    planes = {name: _plane(name, plane) for name, plane in channels.items()}
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1:
        raise ValueError(f"channels differ in size: {sorted(shapes)}")
    height, width = shapes.pop()
    halves = {name for name in planes if (half if isinstance(half, bool) else name in half)}
    data = _checked_window("data", data_window or (0, 0, width - 1, height - 1))
    display = _checked_window("display", display_window or (0, 0, width - 1, height - 1))
    if (data[3] - data[1] + 1, data[2] - data[0] + 1) != (height, width):
        raise ValueError(f"an image of {width} x {height} pixels can't fill the data window {data}")
    header = {key: _attribute(key, value) for key, value in (attributes or {}).items()}

    def encode(stream: BinaryIO) -> None:
        if compression in exrencode.COMPRESSIONS:
            for piece in exrencode.encode(planes, halves, data, display, compression, header):
                stream.write(piece)
            return
        # contiguous: strided arrays the library writes wrongly without an error (issue 1929)
        stored = {
            name: floats.to_half(plane) if name in halves else np.ascontiguousarray(plane, "f4")
            for name, plane in planes.items()
        }
        entries = {name: value for name, value in header.items() if isinstance(value, Entry)}
        settings = {name: value for name, value in header.items() if name not in entries} | {
            "compression": COMPRESSIONS[compression],
            "type": OpenEXR.scanlineimage,
            "dataWindow": _corners(data),
            "displayWindow": _corners(display),
        }
        with OpenEXR.File(settings, stored, num_threads=_library_threads()) as file:
            if not entries:
                file.write(stream)
                return
            body = io.BytesIO()
            file.write(body)
        for part in exrencode.with_entries(body.getbuffer(), entries):
            stream.write(part)

    if isinstance(target, (str, os.PathLike)):
        with replacing(Path(target)) as temporary, temporary.open("wb") as stream:
            encode(stream)
    else:
        encode(target)


def fetch(source: Path | str | bytes, limits: Limits) -> bytes:
    """The bytes of a file, or `source` itself. Raises ImageError, LimitError.

    Read once, so that what was checked is what gets decoded; not mapped, because a mapped file
    that someone truncates meanwhile kills the process.
    """
    if isinstance(source, (bytes, bytearray, memoryview)):
        return bytes(source)  # no copy of what is bytes already
    path = Path(source)
    try:
        limits.check("body_bytes", path.stat().st_size)
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"can't read {path}: {error.strerror}") from error


def _plane(name: str, plane: ArrayLike) -> NDArray[Any]:
    array = np.asarray(plane)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"channel '{name}' has shape {array.shape}, it must be (height, width)")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"channel '{name}' holds {array.dtype}, not numbers")
    return array


def _attribute(key: str, value: Any) -> Any:
    if isinstance(value, (int, np.integer, np.bool_)):
        return int(value) if -(2**31) <= value < 2**31 else str(value)
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, str | Entry):
        return value
    if isinstance(value, (np.ndarray, Sequence)) and not isinstance(value, bytes):
        array = np.asarray(value)
        if array.shape in ((2,), (3,), (3, 3), (4, 4)) and array.dtype.kind in "iuf":
            whole = array.dtype.kind in "iu" and array.ndim == 1
            return np.ascontiguousarray(array, np.int32 if whole else np.float32)
    raise ValueError(f"the header attribute '{key}' can't hold {value!r:.60}")


def _checked_window(name: str, window: Window) -> Window:
    x0, y0, x1, y1 = map(int, window)
    if x1 < x0 or y1 < y0 or max(map(abs, (x0, y0, x1, y1))) > MAX_COORDINATE:
        raise ValueError(f"no EXR can hold the {name} window {window} (x0, y0, x1, y1)")
    return x0, y0, x1, y1


def _corners(window: Window) -> tuple[Any, Any]:
    return np.array(window[:2], np.int32), np.array(window[2:], np.int32)


def _library_threads() -> int:
    """How many threads the library may use to write a file; starts its pool on first use.

    The pool is empty by default, which means serial. A forked child inherits its size but none of
    its threads, and would wait for them forever: there it is 0.
    """
    global _pool_owner
    if _pool_owner == 0:
        OpenEXR.set_global_thread_count(thread_count())
        _pool_owner = os.getpid()
    return thread_count() if _pool_owner == os.getpid() else 0
