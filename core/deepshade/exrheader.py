"""Reads and checks an OpenEXR header without decoding a pixel.

The bytes come from people we don't know. So every loop here is bounded, nothing is allocated
because a header says so, and whatever the decoder would have to trust (windows, chunk tables,
sizes) is proven against the bytes that are really there. Layout: "OpenEXR File Layout",
openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DamagedImageError, ImageError, LimitError

Window = tuple[int, int, int, int]
Buffer = memoryview

_MAGIC = 20000630
_TILED, _LONG_NAMES, _DEEP, _MULTIPART = 0x200, 0x400, 0x800, 0x1000
_MAX_ATTRIBUTES = 4_000  # of all parts; the busiest production files have a few hundred
_MAX_TEXTS = 4_000  # in one attribute
_MAX_COORDINATE = 2**30 - 2  # OpenEXR's own bound on windows
_MAX_TILE = 2**16
_TABLE_BLOCK = 2**16  # chunk table entries checked at a time, to bound the memory it takes

_TYPES = ("uint", "half", "float")
_BYTES = {"uint": 4, "half": 2, "float": 4}

# code -> (name, scanlines in one chunk)
_COMPRESSIONS = {
    0: ("none", 1),
    1: ("rle", 1),
    2: ("zips", 1),
    3: ("zip", 16),
    4: ("piz", 32),
    5: ("pxr24", 16),
    6: ("b44", 32),
    7: ("b44a", 32),
    8: ("dwaa", 32),
    9: ("dwab", 256),
    10: ("htj2k256", 256),
    11: ("htj2k32", 32),
}


@dataclass(frozen=True, slots=True)
class Limits:
    """The most that one image may hold. `pixels` is for each part, the rest for the file."""

    body_bytes: int = 2 * 1024**3
    decoded_bytes: int = 4 * 1024**3
    pixels: int = 8192 * 8192
    parts: int = 64
    channels: int = 1024

    def check(self, limit: str, value: int) -> None:
        """Raises LimitError when `value` exceeds the limit of that name."""
        maximum = getattr(self, limit)
        if value > maximum:
            raise LimitError(limit, value, maximum)


@dataclass(frozen=True, slots=True)
class Part:
    """One part of an EXR file, as its header describes it.

    Windows are (x0, y0, x1, y1), inclusive. `channels` maps names, in the file's order, to
    "half", "float" or "uint"; those in `subsampled` hold fewer values than there are pixels.
    """

    name: str
    channels: dict[str, str]
    data_window: Window
    display_window: Window
    compression: str
    attributes: dict[str, Any]
    decoded_bytes: int
    tiled: bool = False
    subsampled: frozenset[str] = frozenset()

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the stored pixels."""
        x0, y0, x1, y1 = self.data_window
        return y1 - y0 + 1, x1 - x0 + 1


@dataclass(frozen=True, slots=True)
class Header:
    """All parts of an EXR file."""

    parts: tuple[Part, ...]
    body_bytes: int = 0

    @property
    def decoded_bytes(self) -> int:
        """What all pixels of all parts take once decoded."""
        return sum(part.decoded_bytes for part in self.parts)

    def channels(self) -> dict[str, tuple[int, str]]:
        """Every channel: its name -> (part index, name within the part).

        A name that several parts share is qualified, "part:channel".
        """
        counts = Counter(name for part in self.parts for name in part.channels)
        part_names = [part.name for part in self.parts]
        labels = [
            name if name and part_names.count(name) == 1 else str(index)
            for index, name in enumerate(part_names)
        ]
        return {
            (f"{labels[index]}:{name}" if counts[name] > 1 else name): (index, name)
            for index, part in enumerate(self.parts)
            for name in part.channels
        }


@dataclass(slots=True)
class _Raw:
    """One part's header while it is being read."""

    attributes: dict[str, Any] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    subsampled: set[str] = field(default_factory=set)


def parse(data: Buffer, limits: Limits) -> Header:
    """The header of a whole EXR file in memory, with its chunk tables checked.

    Raises ImageError (no EXR, or a kind we don't read), DamagedImageError, LimitError.
    """
    limits.check("body_bytes", len(data))
    if len(data) < 4 or struct.unpack_from("<I", data, 0)[0] != _MAGIC:
        raise ImageError(
            "not an OpenEXR image" if len(data) else "the image is empty",
            fix="send an .exr file",
        )
    cursor = _Cursor(data, 4)
    flags = cursor.unpack("<I")[0]
    if flags & 0xFF != 2:
        raise ImageError(f"OpenEXR file version {flags & 0xFF}; only version 2 is known")
    if flags & ~(0xFF | _TILED | _LONG_NAMES | _DEEP | _MULTIPART):
        raise ImageError("the file uses OpenEXR features that are unknown here")
    if flags & _DEEP:
        raise _deep()
    multipart = bool(flags & _MULTIPART)
    raws = [_read_part(cursor, limits, _MAX_ATTRIBUTES)]
    left = _MAX_ATTRIBUTES - len(raws[0].types)
    while multipart and cursor.peek() != 0:
        limits.check("parts", len(raws) + 1)
        raws.append(_read_part(cursor, limits, left))
        left -= len(raws[-1].types)
        limits.check("channels", sum(len(raw.channels) for raw in raws))
    if multipart:
        cursor.skip(1)
    limits.check("channels", sum(len(raw.channels) for raw in raws))

    checked = [_check_part(raw, flags, index, limits) for index, raw in enumerate(raws)]
    header = Header(tuple(part for part, _ in checked), len(data))
    limits.check("decoded_bytes", header.decoded_bytes)
    # the tables of all parts come first, then all the chunks
    tables = [(part, cursor.table(count)) for part, count in checked]
    for index, (part, table) in enumerate(tables):
        missing = table.size - int(np.count_nonzero(table))
        if missing:
            raise DamagedImageError(
                f"the image is incomplete: {missing} of {table.size} chunks were never written",
                fix="wait until the renderer has finished, or render again",
            )
        number = index if multipart else None
        for start in range(0, table.size, _TABLE_BLOCK):
            block = table[start : start + _TABLE_BLOCK]
            _check_chunks(data, part, number, block, start=start, first=cursor.at)
    return header


class _Cursor:
    """A place in the bytes that can't run past their end."""

    def __init__(self, data: Buffer, at: int) -> None:
        self.data = data
        self.at = at

    def skip(self, count: int) -> int:
        start = self.at
        if count < 0 or count > len(self.data) - start:
            raise _truncated("within the header")
        self.at = start + count
        return start

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def peek(self) -> int:
        if self.at >= len(self.data):
            raise _truncated("within the header")
        return self.data[self.at]

    def name(self) -> str:
        window = bytes(self.data[self.at : self.at + 256])
        end = window.find(b"\0")
        if end < 0:
            if len(window) < 256:
                raise _truncated("within the header")
            raise DamagedImageError("the header holds a name longer than 255 bytes")
        self.at += end + 1
        return window[:end].decode("utf-8", "replace")

    def table(self, count: int) -> NDArray[np.uint64]:
        if count > (len(self.data) - self.at) // 8:
            raise _truncated("within the chunk table")
        start = self.skip(8 * count)
        return np.frombuffer(self.data, "<u8", count, start)


def _read_part(cursor: _Cursor, limits: Limits, most: int) -> _Raw:
    """One part's header, which may have at most `most` attributes."""
    raw = _Raw()
    for _ in range(most + 1):
        name = cursor.name()
        if not name:
            return raw
        kind = cursor.name()
        (size,) = cursor.unpack("<i")
        start = cursor.skip(size)
        value = cursor.data[start : start + size]
        if name in raw.types:
            raise DamagedImageError(f"the header has the attribute '{name}' twice")
        raw.types[name] = kind
        if name == "channels" and kind == "chlist":
            _read_channels(value, raw, limits)
        elif kind in _DECODERS:
            try:
                raw.attributes[name] = _DECODERS[kind](value)
            except (struct.error, ValueError, IndexError):
                raise DamagedImageError(
                    f"the header attribute '{name}' is no valid {kind}"
                ) from None
    raise ImageError(
        f"the header has over {_MAX_ATTRIBUTES:,} attributes", fix="save it without metadata"
    )


def _read_channels(value: Buffer, raw: _Raw, limits: Limits) -> None:
    cursor = _Cursor(value, 0)
    while True:
        name = cursor.name()
        if not name:
            return
        kind, _, x_sampling, y_sampling = cursor.unpack("<iB3xii")
        if not 0 <= kind < len(_TYPES):
            raise DamagedImageError(f"channel '{name}' has the unknown pixel type {kind}")
        if x_sampling < 1 or y_sampling < 1:
            raise DamagedImageError(f"channel '{name}' is sampled every {x_sampling} pixels")
        if name in raw.channels:
            raise DamagedImageError(f"the header has the channel '{name}' twice")
        raw.channels[name] = _TYPES[kind]
        if (x_sampling, y_sampling) != (1, 1):
            raw.subsampled.add(name)
        limits.check("channels", len(raw.channels))


def _check_part(raw: _Raw, flags: int, index: int, limits: Limits) -> tuple[Part, int]:
    """The part, and how many chunks it must have. Raises if the header contradicts itself."""
    multipart = bool(flags & _MULTIPART)
    where = f"part {index}: " if multipart else ""
    for name, kind in _REQUIRED.items():
        if raw.types.get(name) != kind:
            raise DamagedImageError(f"{where}the header has no valid '{name}'")
    if not raw.channels:
        raise ImageError(f"{where}the image has no channels")
    storage = raw.attributes.get("type", "tiledimage" if flags & _TILED else "scanlineimage")
    if storage in ("deepscanline", "deeptile"):
        raise _deep()
    if multipart and not (raw.attributes.get("name") and "type" in raw.attributes):
        raise DamagedImageError(f"{where}a part of a multi-part file needs a name and a type")
    if storage not in ("scanlineimage", "tiledimage"):
        raise ImageError(f"{where}unknown kind of part '{str(storage)[:40]}'")
    tiled = storage == "tiledimage"
    if not multipart and tiled != bool(flags & _TILED):
        raise DamagedImageError("the header's type contradicts its version flags")

    data_window = _checked_window(raw, "dataWindow", where)
    display_window = _checked_window(raw, "displayWindow", where)
    width = data_window[2] - data_window[0] + 1
    height = data_window[3] - data_window[1] + 1
    limits.check("pixels", width * height)
    pixel_bytes = sum(_BYTES[kind] for kind in raw.channels.values())
    decoded = width * height * pixel_bytes

    code = raw.attributes["compression"]
    if code not in _COMPRESSIONS:
        raise ImageError(
            f"{where}compression number {code} is unknown here", fix="save it with ZIP compression"
        )
    compression, lines = _COMPRESSIONS[code]
    if tiled:
        if raw.types.get("tiles") != "tiledesc":
            raise DamagedImageError(f"{where}a tiled part without a tile description")
        if raw.subsampled:
            raise DamagedImageError(f"{where}a tiled part can't have subsampled channels")
        chunks, tile_pixels, scale = _tile_count(raw.attributes["tiles"], width, height, where)
        decoded = math.ceil(decoded * scale)
        # the decoder allocates whole tiles, however small the image is
        limits.check("decoded_bytes", tile_pixels * pixel_bytes)
    else:
        chunks = -(-height // lines)
    declared = raw.attributes.get("chunkCount")
    if declared is not None and declared != chunks:
        raise DamagedImageError(f"{where}the header says {declared} chunks, it must be {chunks}")
    if multipart and declared is None:
        raise DamagedImageError(f"{where}the header has no valid 'chunkCount'")

    attributes = {k: v for k, v in raw.attributes.items() if k not in _STRUCTURE}
    part = Part(
        name=str(raw.attributes.get("name", "")),
        channels=raw.channels,
        data_window=data_window,
        display_window=display_window,
        compression=compression,
        attributes=attributes,
        decoded_bytes=decoded,
        tiled=tiled,
        subsampled=frozenset(raw.subsampled),
    )
    return part, chunks


def _checked_window(raw: _Raw, name: str, where: str) -> Window:
    x0, y0, x1, y1 = raw.attributes[name]
    if x1 < x0 or y1 < y0:
        raise DamagedImageError(f"{where}the {name} is empty: ({x0}, {y0}) to ({x1}, {y1})")
    if max(map(abs, (x0, y0, x1, y1))) > _MAX_COORDINATE:
        raise DamagedImageError(f"{where}the {name} is absurd: ({x0}, {y0}) to ({x1}, {y1})")
    return x0, y0, x1, y1


def _tile_count(
    tiles: tuple[int, int, int], width: int, height: int, where: str
) -> tuple[int, int, float]:
    """(number of tiles on all levels, pixels of one tile, pixels of all levels / of the first)."""
    tile_width, tile_height, mode = tiles
    if not (1 <= tile_width <= _MAX_TILE and 1 <= tile_height <= _MAX_TILE):
        raise DamagedImageError(f"{where}absurd tiles of {tile_width} x {tile_height} pixels")
    levels, rounding = mode & 0xF, mode >> 4
    if levels > 2 or rounding > 1:
        raise DamagedImageError(f"{where}unknown tile mode {mode}")

    def sizes(size: int, count: int) -> list[int]:
        up = (1 << np.arange(count, dtype=np.int64)) - 1 if rounding else 0
        return [max(1, int(s)) for s in (size + up) >> np.arange(count)]

    def depth(size: int) -> int:  # levels until 1 pixel is left
        return (math.ceil if rounding else math.floor)(math.log2(size)) + 1

    if levels == 1:
        count = depth(max(width, height))
        pairs = list(zip(sizes(width, count), sizes(height, count), strict=True))
    elif levels == 2:
        pairs = [(w, h) for h in sizes(height, depth(height)) for w in sizes(width, depth(width))]
    else:
        pairs = [(width, height)]
    chunks = sum(-(-w // tile_width) * -(-h // tile_height) for w, h in pairs)
    scale = sum(w * h for w, h in pairs) / (width * height)
    return chunks, tile_width * tile_height, scale


def _check_chunks(
    data: Buffer,
    part: Part,
    number: int | None,
    table: NDArray[np.uint64],
    *,
    start: int,
    first: int,
) -> None:
    """Every chunk must lie in the file, after the tables, and be the one its entry promises.

    `table` holds the entries from `start` on; `first` is where chunks may begin.
    """
    prefix = 0 if number is None else 4
    head = prefix + (20 if part.tiled else 8)
    if int(table.min()) < first or int(table.max()) > len(data) - head:
        raise _truncated("or its chunk table is damaged")
    offsets = table.astype(np.int64)
    view = np.frombuffer(data, np.uint8)

    def field(at: int) -> NDArray[np.int64]:
        picked = view[offsets[:, None] + np.arange(at, at + 4)]
        return np.ascontiguousarray(picked).view("<i4")[:, 0].astype(np.int64)

    sizes = field(head - 4)
    if int(sizes.min()) < 0 or int((offsets + head + sizes).max()) > len(data):
        raise _truncated("or its chunk sizes are damaged")
    if number is not None and not (field(0) == number).all():
        raise DamagedImageError("a chunk belongs to another part than its table says")
    if not part.tiled:
        lines = dict(_COMPRESSIONS.values())[part.compression]
        rows = part.data_window[1] + lines * np.arange(start, start + table.size, dtype=np.int64)
        if not (field(prefix) == rows).all():
            raise DamagedImageError("a chunk holds other scanlines than its table entry says")


def _deep() -> ImageError:
    return ImageError("deep images are not supported", fix="flatten it: one value a pixel")


def _truncated(where: str) -> DamagedImageError:
    return DamagedImageError(f"the image is truncated, {where}", fix="send the whole file again")


def _text(value: Buffer) -> str:
    return bytes(value).decode("utf-8", "replace")


def _texts(value: Buffer) -> list[str]:
    cursor = _Cursor(value, 0)
    out: list[str] = []
    while cursor.at < len(value):
        if len(out) == _MAX_TEXTS:
            raise ValueError
        (size,) = cursor.unpack("<i")
        start = cursor.skip(size)
        out.append(_text(value[start : start + size]))
    return out


def _scalar(layout: str) -> Callable[[Buffer], Any]:
    return lambda value: struct.unpack(layout, value)[0]


def _tuple(layout: str) -> Callable[[Buffer], Any]:
    return lambda value: struct.unpack(layout, value)


def _matrix(kind: str, size: int) -> Callable[[Buffer], Any]:
    return lambda value: np.frombuffer(bytes(value), kind).reshape(size, size)


_DECODERS: dict[str, Callable[[Buffer], Any]] = {
    "string": _text,
    "stringvector": _texts,
    "int": _scalar("<i"),
    "float": _scalar("<f"),
    "double": _scalar("<d"),
    "compression": _scalar("<B"),
    "lineOrder": _scalar("<B"),
    "envmap": _scalar("<B"),
    "v2i": _tuple("<2i"),
    "v2f": _tuple("<2f"),
    "v2d": _tuple("<2d"),
    "v3i": _tuple("<3i"),
    "v3f": _tuple("<3f"),
    "v3d": _tuple("<3d"),
    "box2i": _tuple("<4i"),
    "box2f": _tuple("<4f"),
    "m33f": _matrix("<f4", 3),
    "m33d": _matrix("<f8", 3),
    "m44f": _matrix("<f4", 4),
    "m44d": _matrix("<f8", 4),
    "chromaticities": _tuple("<8f"),
    "rational": _tuple("<iI"),
    "timecode": _tuple("<2I"),
    "keycode": _tuple("<7i"),
    "tiledesc": _tuple("<2IB"),
    "floatvector": lambda value: np.frombuffer(bytes(value), "<f4"),
}
_REQUIRED = {
    "channels": "chlist",
    "compression": "compression",
    "dataWindow": "box2i",
    "displayWindow": "box2i",
    "lineOrder": "lineOrder",
    "pixelAspectRatio": "float",
    "screenWindowCenter": "v2f",
    "screenWindowWidth": "float",
}
_STRUCTURE = {"compression", "dataWindow", "displayWindow", "name", "type", "chunkCount", "tiles"}
