"""Encodes single-part scanline EXR files, compressed with ZIP: chunks on several threads.

The OpenEXR library writes all kinds of files; this writes the commonest kind several times faster.
Layout: "OpenEXR File Layout", openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from deepshade import floats
from deepshade.exr.attributes import Cursor
from deepshade.exr.chunks import LONG_NAMES, MAGIC, Window
from deepshade.exr.entries import Entry
from deepshade.threads import run_all, thread_count

# name -> (code, scanlines in one chunk)
COMPRESSIONS = {"zips": (2, 1), "zip": (3, 16)}

_LEVEL = 1  # the higher ones are slower and hardly smaller

# Bytes before compression that a thread encodes at a time: few and large, for between two steps
# the threads wait for each other; but only a few of them are in memory beside the output.
MAX_STRIP = 2**20
MIN_STRIP = 2**17

MAX_NAME = 255  # bytes
_SHORT_NAME = 31
MAX_CHUNK = 2**31 - 1
_HALF, _FLOAT = 1, 2  # pixel types

_REQUIRED: dict[str, Any] = {  # unless the caller has others of the same type
    "pixelAspectRatio": 1.0,
    "screenWindowCenter": np.zeros(2, np.float32),
    "screenWindowWidth": 1.0,
}


def encode(
    channels: Mapping[str, NDArray[Any]],
    half: Collection[str],
    data_window: Window,
    display_window: Window,
    compression: str,
    attributes: Mapping[str, Any],
) -> list[bytes]:
    """The file, as consecutive pieces of its bytes.

    `channels` are (H, W) arrays of numbers, of the size of `data_window`; those in `half` are
    stored in 16 bits, the others in 32. `compression` is one of `COMPRESSIONS`. `attributes` are
    int, float, str, Entry, and arrays that are int32 (2,) or (3,), or float32 (2,), (3,), (3, 3) or
    (4, 4). Raises ValueError for names or attributes that no such file can hold.
    """
    code, lines = COMPRESSIONS[compression]
    planes = [(name in half, channels[name]) for name in sorted(channels)]
    height, width = planes[0][1].shape
    line_bytes = width * sum(2 if is_half else 4 for is_half, _ in planes)
    if lines * line_bytes > MAX_CHUNK:
        raise ValueError(f"{lines} scanlines of {line_bytes:,} bytes are too much for a chunk")
    layout = struct.Struct("<iB3xii")  # pixel type, linear, and every pixel is sampled
    channel_list = b"".join(
        _name(name) + layout.pack(_HALF if name in half else _FLOAT, 0, 1, 1)
        for name in sorted(channels)
    )
    structure = {
        "channels": ("chlist", channel_list + bytes(1)),
        "compression": ("compression", bytes([code])),
        "dataWindow": ("box2i", struct.pack("<4i", *data_window)),
        "displayWindow": ("box2i", struct.pack("<4i", *display_window)),
        "lineOrder": ("lineOrder", b"\0"),
        "type": ("string", b"scanlineimage"),
    }
    header = _header(structure, attributes, channels)
    threads = thread_count()
    piece = min(MAX_STRIP, max(MIN_STRIP, -(-height * line_bytes // threads)))
    strip = lines * -(-piece // (lines * line_bytes))
    starts = range(0, height, strip)
    encoded: list[list[bytes]] = [[]] * len(starts)

    def work(index: int) -> None:
        rows = slice(starts[index], min(starts[index] + strip, height))
        bodies = _strip([(is_half, plane[rows]) for is_half, plane in planes], lines)
        first = data_window[1] + rows.start
        encoded[index] = [
            struct.pack("<2i", first + lines * n, len(body)) + body for n, body in enumerate(bodies)
        ]

    run_all(work, range(len(starts)), threads)
    chunks = list(itertools.chain.from_iterable(encoded))
    begin = len(header) + 8 * len(chunks)
    table = np.cumsum([begin, *(len(chunk) for chunk in chunks[:-1])], dtype="<u8")
    return [header, table.tobytes(), *chunks]


def with_entries(body: memoryview, entries: Mapping[str, Entry]) -> list[memoryview | bytes]:
    """A single-part file with more header attributes, as consecutive pieces of its bytes.

    The library writes no rational numbers, and so not every entry.
    """
    cursor = Cursor(body, 8)  # after magic number and version
    while cursor.name():
        cursor.name()  # its type
        cursor.skip(*cursor.unpack("<i"))
    more = b"".join(_attribute(name, each.kind, each.data) for name, each in entries.items())
    table_at = cursor.at
    (first,) = cursor.unpack("<Q")  # of the chunks, which follow their table
    table = np.frombuffer(body[table_at:first], "<u8") + np.uint64(len(more))
    return [body[: table_at - 1], more, bytes(1), table.tobytes(), body[first:]]


def _strip(planes: list[tuple[bool, NDArray[Any]]], lines: int) -> list[bytes]:
    """The chunks of some scanlines, `lines` in each but the last, which may have fewer."""
    stored = [
        floats.to_half(plane) if is_half else np.ascontiguousarray(plane, np.float32)
        for is_half, plane in planes
    ]
    views = [array.view(np.uint8) for array in stored]
    raw = views[0] if len(views) == 1 else np.concatenate(views, axis=1)
    whole = len(raw) // lines
    bodies = _chunks(raw[: whole * lines].reshape(whole, -1)) if whole else []
    if len(raw) > whole * lines:
        bodies += _chunks(raw[whole * lines :].reshape(1, -1))
    return bodies


def _chunks(raw: NDArray[np.uint8]) -> list[bytes]:
    """(chunks, bytes of each), compressed; those that don't become smaller as they are."""
    # the low bytes of all 16-bit words, then the high ones: like stands by like
    words = raw.view("<u2")
    split = np.empty_like(raw)
    split[:, : words.shape[1]] = words
    split[:, words.shape[1] :] = words >> np.uint16(8)
    steps = split.copy()  # each byte's difference to the one before, plus 128
    steps[:, 1:] -= split[:, :-1]
    steps[:, 1:] += np.uint8(128)
    bodies = []
    for row, step in zip(raw, steps, strict=True):
        body = isal_zlib.compress(step, _LEVEL)
        bodies.append(body if len(body) < row.size else row.tobytes())
    return bodies


def _header(
    structure: Mapping[str, tuple[str, bytes]],
    attributes: Mapping[str, Any],
    channels: Iterable[str],
) -> bytes:
    """All that comes before the chunk table; `structure` holds (type, value)."""
    attributes = {**_REQUIRED, **attributes}
    values = {name: _value(value) for name, value in attributes.items()}
    for name, default in _REQUIRED.items():
        if values[name][0] != (kind := _value(default)[0]):
            raise ValueError(f"the header attribute '{name}' must be {kind}, not {values[name][0]}")
    aspect, width = attributes["pixelAspectRatio"], attributes["screenWindowWidth"]
    if not (0 < aspect < float("inf") and 0 <= width < float("inf")):
        raise ValueError(f"no EXR has a pixel aspect of {aspect} or a screen window {width} wide")
    for name in ("channels", "lineOrder", "chunkCount"):
        if name in attributes:
            raise ValueError(f"the header attribute '{name}' can't be chosen")
    pieces = [_attribute(name, *each) for name, each in sorted({**values, **structure}.items())]
    long = any(len(name.encode()) > _SHORT_NAME for name in (*values, *channels))
    start = struct.pack("<2I", MAGIC, 2 | (LONG_NAMES if long else 0))
    return b"".join((start, *pieces, b"\0"))


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    return _name(name) + _name(kind) + struct.pack("<i", len(value)) + value


def _name(name: str) -> bytes:
    code = name.encode()
    if not 0 < len(code) <= MAX_NAME or 0 in code:
        raise ValueError(f"no EXR can hold the name {name!r:.60}: 1 to 255 bytes, none of them 0")
    return code + bytes(1)


def _value(value: Any) -> tuple[str, bytes]:
    """An attribute's type and bytes."""
    if isinstance(value, Entry):
        return value.kind, value.data
    if isinstance(value, int):
        return "int", struct.pack("<i", value)
    if isinstance(value, str):
        return "string", value.encode()
    if isinstance(value, float):
        with np.errstate(over="ignore"):
            return "float", np.float32(value).astype("<f4").tobytes()
    vector_or_matrix = "v" if value.ndim == 1 else "m"
    sides = "".join(map(str, value.shape))  # as in v3f or m44f
    stored = value.astype(value.dtype.newbyteorder("<")).tobytes()
    return f"{vector_or_matrix}{sides}{value.dtype.kind}", stored
