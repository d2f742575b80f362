"""Reads and writes OpenEXR images; the only module that touches the OpenEXR library."""

from __future__ import annotations

import io
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import ArrayLike, NDArray

from deepshade.errors import DamagedImageError, ImageError
from deepshade.exrheader import Header, Limits, Part, Window, parse
from deepshade.files import replacing
from deepshade.machine import cpu_count

__all__ = [
    "COMPRESSIONS",
    "Header",
    "Image",
    "Limits",
    "Part",
    "Window",
    "fetch",
    "read",
    "read_header",
    "write",
]

Pixels = NDArray[np.float32]

_HALF_MAX = 65504.0
COMPRESSIONS = {
    name.removesuffix("_COMPRESSION").lower().replace("no", "none"): member
    for name, member in OpenEXR.Compression.__members__.items()
    if name.removesuffix("_COMPRESSION")
    in ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
}

_THREADED = {"zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab", "htj2k256", "htj2k32"}
_pool_owner = 0


@dataclass(frozen=True, slots=True)
class Image:
    """Decoded pixels: name in `header.channels()` -> (H, W) float32, C-contiguous."""

    header: Header
    pixels: dict[str, Pixels]

    def stack(self, names: Sequence[str]) -> Pixels:
        """Channels as one (C, H, W) array; no copy when they were read in this order."""
        planes = [self.pixels[name] for name in names]
        block = planes[0].base
        if (
            isinstance(block, np.ndarray)
            and block.ndim == 3
            and block.dtype == np.float32
            and all(plane.base is block for plane in planes)
        ):
            starts = [plane.ctypes.data - block.ctypes.data for plane in planes]
            step = planes[0].nbytes
            index = starts[0] // step if step else 0
            if starts == [(index + k) * step for k in range(len(planes))]:
                return block[index : index + len(planes)]
        return np.stack(planes)


def read_header(source: Path | str | bytes, limits: Limits | None = None) -> Header:
    """The checked header of an EXR file or of its bytes; no pixel is decoded.

    Limits, windows, and whether every chunk really lies in the file are checked here.
    Raises ImageError, DamagedImageError, LimitError.
    """
    limits = limits or Limits()
    return parse(memoryview(fetch(source, limits)), limits)


def read(
    source: Path | str | bytes,
    channels: Collection[str] | None = None,
    limits: Limits | None = None,
    *,
    header: Header | None = None,
) -> Image:
    """Decodes an EXR file, or its bytes, into float32 (half and uint are converted).

    `channels` selects, and orders in memory, the wanted ones by their `Header.channels()`
    names; None is all. `header` is what `read_header` gave for the same bytes, to spare reading
    it again. Raises ImageError, DamagedImageError, LimitError.
    """
    limits = limits or Limits()
    data = fetch(source, limits)
    header = header or parse(memoryview(data), limits)
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
    try:
        stream = io.BytesIO(data)
        with OpenEXR.File(stream, separate_channels=True, num_threads=_threads(header)) as file:
            if len(file.parts) != len(header.parts):
                raise DamagedImageError("the image is damaged: a part can't be read")
            return Image(header, _convert(file.parts, header, places, wanted))
    except DamagedImageError:
        raise
    except MemoryError:
        raise
    except Exception as error:
        raise DamagedImageError(
            f"the image is damaged: {_reason(error)}", fix="save or send the file again"
        ) from error


def write(
    target: Path | str | BinaryIO,
    channels: Mapping[str, ArrayLike],
    *,
    attributes: Mapping[str, Any] | None = None,
    compression: str = "zip",
    half: bool | Collection[str] = False,
    frame: tuple[int, int] | None = None,
    origin: tuple[int, int] = (0, 0),
) -> None:
    """Writes a single-part scanline EXR.

    `channels` maps names to (H, W) arrays, all of one size. `half` says which of them are
    stored in 16 bits: all, none, or those named; finite values beyond ±65504 are clamped there
    rather than turned into infinities. `frame` is the display window's (width, height), the
    image's own size by default; `origin` is where its first pixel lies in that frame.
    `attributes` are numbers, strings, 2- or 3-vectors, 3x3 or 4x4 matrices; an integer beyond
    32 bits is stored as text. A path is replaced atomically: written beside, synced, renamed.
    Raises ValueError for arrays or settings that no EXR can hold.
    """
    if compression not in COMPRESSIONS:
        raise ValueError(f"unknown compression '{compression}', one of: {', '.join(COMPRESSIONS)}")
    if not channels:
        raise ValueError("an image needs at least one channel")
    planes = {name: _encodable(name, plane, half) for name, plane in channels.items()}
    shapes = {plane.shape for plane in planes.values()}
    if len(shapes) != 1:
        raise ValueError(f"channels differ in size: {sorted(shapes)}")
    height, width = shapes.pop()
    frame = frame or (width, height)
    header = {key: _attribute(key, value) for key, value in (attributes or {}).items()}
    header |= {
        "compression": COMPRESSIONS[compression],
        "type": OpenEXR.scanlineimage,
        "dataWindow": _window(*origin, width, height),
        "displayWindow": _window(0, 0, *frame),
    }
    threads = _threads() if compression in _THREADED else 0
    with OpenEXR.File(header, planes, num_threads=threads) as file:
        if isinstance(target, (str, os.PathLike)):
            with replacing(Path(target)) as temporary:
                file.write(os.fspath(temporary))
        else:
            file.write(target)


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


def _convert(
    parts: Sequence[Any], header: Header, places: dict[str, tuple[int, str]], wanted: list[str]
) -> dict[str, Pixels]:
    blocks: dict[tuple[int, int], list[str]] = {}
    for name in wanted:
        blocks.setdefault(header.parts[places[name][0]].shape, []).append(name)
    pixels: dict[str, Pixels] = {}
    for shape, names in blocks.items():
        block = np.empty((len(names), *shape), np.float32)
        for plane, name in zip(block, names, strict=True):
            index, channel = places[name]
            stored = parts[index].channels[channel].pixels
            if stored.shape != shape:
                raise DamagedImageError(f"the image is damaged: channel '{name}' is incomplete")
            np.copyto(plane, stored, casting="same_kind" if stored.dtype.kind == "f" else "unsafe")
            pixels[name] = plane
    return {name: pixels[name] for name in wanted}


def _encodable(name: str, plane: ArrayLike, half: bool | Collection[str]) -> NDArray[Any]:
    array = np.asarray(plane)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"channel '{name}' has shape {array.shape}, it must be (height, width)")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"channel '{name}' holds {array.dtype}, not numbers")
    if half if isinstance(half, bool) else name in half:
        if array.dtype != np.float16:
            array = np.asarray(array, np.float32)
            limited = np.clip(array, -_HALF_MAX, _HALF_MAX)
            np.copyto(limited, array, where=np.isinf(array))
            array = limited.astype(np.float16)
    else:
        array = array.astype(np.float32, copy=False)
    # strided arrays are written wrongly without an error: OpenEXR issue 1929
    return np.ascontiguousarray(array)


def _attribute(key: str, value: Any) -> Any:
    if isinstance(value, (bool, np.bool_)):
        return int(value)
    if isinstance(value, (int, np.integer)):
        return int(value) if -(2**31) <= value < 2**31 else str(value)
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, str):
        return value
    if isinstance(value, (np.ndarray, Sequence)) and not isinstance(value, bytes):
        array = np.asarray(value)
        if array.shape in ((2,), (3,), (3, 3), (4, 4)) and array.dtype.kind in "iuf":
            whole = array.dtype.kind in "iu" and array.ndim == 1
            return np.ascontiguousarray(array, np.int32 if whole else np.float32)
    raise ValueError(f"the header attribute '{key}' can't hold {value!r:.60}")


def _window(x0: int, y0: int, width: int, height: int) -> tuple[Any, Any]:
    return (
        np.array([x0, y0], np.int32),
        np.array([x0 + width - 1, y0 + height - 1], np.int32),
    )


def _threads(header: Header | None = None) -> int:
    """How many threads OpenEXR may use for a file; starts its pool on first use.

    Only compressions that pack many scanlines into a chunk gain (ZIP halves its time on two
    cores); with one scanline a chunk, handing over costs more than decoding. The pool is empty by
    default, which means serial. A forked child inherits its size but none of its threads, and
    would wait for them forever: there it is 0.
    """
    global _pool_owner
    if cpu_count() == 1 or (header and header.parts[0].compression not in _THREADED):
        return 0
    if _pool_owner == 0:
        OpenEXR.set_global_thread_count(min(cpu_count(), 8))
        _pool_owner = os.getpid()
    return min(cpu_count(), 8) if _pool_owner == os.getpid() else 0


def _reason(error: Exception) -> str:
    text = str(error).replace('"<python_buffer>"', "").strip()
    return text.splitlines()[0][:200] if text else type(error).__name__
