"""Reads and checks an OpenEXR header without decoding a pixel.

The bytes come from people we don't know. So every loop here is bounded, nothing is allocated
because a header says so, and whatever the decoder would have to trust (windows, chunk tables,
sizes) is proven against the bytes that are really there. Layout: "OpenEXR File Layout",
openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import OpenEXR

from deepshade.errors import DamagedImageError, ImageError
from deepshade.exr import chunks as exrchunks
from deepshade.exr.attributes import MAX_ATTRIBUTES, Buffer, Cursor, RawPart, read_part
from deepshade.exr.chunks import DEEP, LONG_NAMES, MAGIC, MULTIPART, TILED, Chunks, Window
from deepshade.exr.entries import Entry, kept
from deepshade.exr.limits import Limits

LIBRARY_VERSION = tuple(int(number) for number in re.findall(r"\d+", OpenEXR.OPENEXR_VERSION)[:3])
MIN_HTJ2K_VERSION = (3, 4, 14)  # its decoder had known bugs before

MAX_COORDINATE = 2**30 - 2  # OpenEXR's own bound on windows
MAX_TILE = 2**16
_BYTES = {"uint": 4, "half": 2, "float": 4}

# In the order of their codes. The last can only be read: the library writes the others.
WRITABLE = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab", "htj2k256")
_NAMES = (*WRITABLE, "htj2k32")
# scanlines in a chunk of each
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32)


@dataclass(frozen=True, slots=True)
class Part:
    """One part of an EXR file, as its header describes it.

    Windows are (x0, y0, x1, y1), inclusive. `channels` maps names, in the file's order, to
    "half", "float" or "uint"; those in `subsampled` hold fewer values than there are pixels.
    `chunks` says where the pixels lie in the file's bytes, `entries` what an answer keeps.
    """

    name: str
    channels: dict[str, str]
    data_window: Window
    display_window: Window
    compression: str
    attributes: dict[str, Any]
    decoded_bytes: int
    chunks: Chunks = field(repr=False, compare=False)
    tiled: bool = False
    subsampled: frozenset[str] = frozenset()
    entries: dict[str, Entry] = field(default_factory=dict, repr=False)

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


def parse(data: Buffer, limits: Limits) -> Header:
    """The header of a whole EXR file in memory, with its chunk tables checked.

    Raises ImageError (no EXR, or a kind we don't read), DamagedImageError, LimitError.
    """
    limits.check("body_bytes", len(data))
    if len(data) < 4 or struct.unpack_from("<I", data, 0)[0] != MAGIC:
        raise ImageError(
            "not an OpenEXR image" if len(data) else "the image is empty",
            fix="send an .exr file",
        )
    cursor = Cursor(data, 4)
    flags = cursor.unpack("<I")[0]
    if flags & 0xFF != 2:
        raise ImageError(f"OpenEXR file version {flags & 0xFF}; only version 2 is known")
    if flags & ~(0xFF | TILED | LONG_NAMES | DEEP | MULTIPART):
        raise ImageError("the file uses OpenEXR features that are unknown here")
    if flags & DEEP:
        raise _deep()
    multipart = bool(flags & MULTIPART)
    raws = [read_part(cursor, limits, MAX_ATTRIBUTES)]
    left = MAX_ATTRIBUTES - len(raws[0].types)
    while multipart and cursor.unpack("B")[0]:  # a zero ends the parts
        cursor.at -= 1
        limits.check("parts", len(raws) + 1)
        raws.append(read_part(cursor, limits, left))
        left -= len(raws[-1].types)
        limits.check("channels", sum(len(raw.channels) for raw in raws))

    # the tables of all parts come first, then all the chunks
    parts = [_check_part(raw, cursor, flags, index, limits) for index, raw in enumerate(raws)]
    header = Header(tuple(parts), len(data))
    limits.check("decoded_bytes", header.decoded_bytes)
    for part in parts:
        exrchunks.check(data, part.chunks, cursor.at)
    return header


def _check_part(raw: RawPart, cursor: Cursor, flags: int, index: int, limits: Limits) -> Part:
    """The part, whose chunk table is next in the bytes. Raises if the header contradicts itself."""
    multipart = bool(flags & MULTIPART)
    where = f"part {index}: " if multipart else ""
    for name, kind in _REQUIRED.items():
        if raw.types.get(name) != kind:
            raise DamagedImageError(f"{where}the header has no valid '{name}'")
    if not raw.channels:
        raise ImageError(f"{where}the image has no channels")
    storage = raw.attributes.get("type", "tiledimage" if flags & TILED else "scanlineimage")
    if storage in ("deepscanline", "deeptile"):
        raise _deep()
    if multipart and not (raw.attributes.get("name") and "type" in raw.attributes):
        raise DamagedImageError(f"{where}a part of a multi-part file needs a name and a type")
    if storage not in ("scanlineimage", "tiledimage"):
        raise ImageError(f"{where}unknown kind of part '{str(storage)[:40]}'")
    tiled = storage == "tiledimage"
    if not multipart and tiled != bool(flags & TILED):
        raise DamagedImageError("the header's type contradicts its version flags")

    data_window = _checked_window(raw, "dataWindow", where)
    display_window = _checked_window(raw, "displayWindow", where)
    width = data_window[2] - data_window[0] + 1
    height = data_window[3] - data_window[1] + 1
    limits.check("pixels", width * height)
    pixel_bytes = sum(_BYTES[kind] for kind in raw.channels.values())
    decoded = width * height * pixel_bytes

    code = raw.attributes["compression"]
    if code >= len(_NAMES):
        raise ImageError(
            f"{where}compression number {code} is unknown here", fix="save it with ZIP compression"
        )
    compression, lines = _NAMES[code], _LINES[code]
    if compression.startswith("htj2k") and LIBRARY_VERSION < MIN_HTJ2K_VERSION:
        raise ImageError(
            f"{where}{compression} compression can't be read safely by the OpenEXR library here, "
            f"{'.'.join(map(str, LIBRARY_VERSION))}",
            fix="save it with ZIP compression, or install OpenEXR 3.4.14 or newer",
        )
    if tiled:
        if raw.types.get("tiles") != "tiledesc":
            raise DamagedImageError(f"{where}a tiled part without a tile description")
        if raw.subsampled:
            raise DamagedImageError(f"{where}a tiled part can't have subsampled channels")
        tile_width, lines, _ = raw.attributes["tiles"]
        count, scale = _tile_count(raw.attributes["tiles"], width, height, where)
        across = -(-width // tile_width)
        decoded = math.ceil(decoded * scale)
        # the decoder allocates whole tiles, however small the image is
        limits.check("decoded_bytes", tile_width * lines * pixel_bytes)
    else:
        count, across = -(-height // lines), 1
    declared = raw.attributes.get("chunkCount")
    if declared is not None and declared != count:
        raise DamagedImageError(f"{where}the header says {declared} chunks, it must be {count}")
    if multipart and declared is None:
        raise DamagedImageError(f"{where}the header has no valid 'chunkCount'")

    attributes = {k: v for k, v in raw.attributes.items() if k not in _STRUCTURE}
    return Part(
        name=str(raw.attributes.get("name", "")),
        channels=raw.channels,
        data_window=data_window,
        display_window=display_window,
        compression=compression,
        attributes=attributes,
        decoded_bytes=decoded,
        chunks=Chunks(
            window=data_window,
            table_at=cursor.skip(8 * count, "chunk table"),
            count=count,
            height=lines,
            number=index if multipart else None,
            header=exrchunks.header_of(raw, tiled=tiled),
            across=across,
            tiled=tiled,
        ),
        tiled=tiled,
        subsampled=frozenset(raw.subsampled),
        entries=kept(raw.types, raw.values),
    )


def _checked_window(raw: RawPart, name: str, where: str) -> Window:
    x0, y0, x1, y1 = raw.attributes[name]
    if x1 < x0 or y1 < y0:
        raise DamagedImageError(f"{where}the {name} is empty: ({x0}, {y0}) to ({x1}, {y1})")
    if max(map(abs, (x0, y0, x1, y1))) > MAX_COORDINATE:
        raise DamagedImageError(f"{where}the {name} is absurd: ({x0}, {y0}) to ({x1}, {y1})")
    return x0, y0, x1, y1


def _tile_count(
    tiles: tuple[int, int, int], width: int, height: int, where: str
) -> tuple[int, float]:
    """(number of tiles on all levels, pixels of all levels / of the first)."""
    tile_width, tile_height, mode = tiles
    if not (1 <= tile_width <= MAX_TILE and 1 <= tile_height <= MAX_TILE):
        raise DamagedImageError(f"{where}absurd tiles of {tile_width} x {tile_height} pixels")
    levels, rounding = mode & 0xF, mode >> 4
    if levels > 2 or rounding > 1:
        raise DamagedImageError(f"{where}unknown tile mode {mode}")

    def sizes(size: int) -> list[int]:  # of each level, until 1 pixel is left
        found = [size]
        while found[-1] > 1:
            found.append((found[-1] + rounding) // 2)
        return found

    pairs: list[tuple[int, ...]] = [(width, height)]
    if levels == 1:
        pairs = list(itertools.zip_longest(sizes(width), sizes(height), fillvalue=1))
    elif levels == 2:
        pairs = list(itertools.product(sizes(width), sizes(height)))
    chunks = sum(-(-w // tile_width) * -(-h // tile_height) for w, h in pairs)
    scale = sum(w * h for w, h in pairs) / (width * height)
    return chunks, scale


def _deep() -> ImageError:
    return ImageError("deep images are not supported", fix="flatten it: one value a pixel")


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
