"""Where a part's pixels lie in an EXR file: proven against the bytes, and cut into small files.

The OpenEXR library decodes whole files: all parts, all scanlines. A file made of a part's header
and some of its chunks is an EXR file too, so what isn't wanted need not be decoded, several
threads can decode one image, and only a strip at a time is there with all its channels.
Layout: "OpenEXR File Layout", openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DamagedImageError
from deepshade.exr.attributes import Buffer, RawPart, truncated

Window = tuple[int, int, int, int]

MAGIC = 20000630
TILED, LONG_NAMES, DEEP, MULTIPART = 0x200, 0x400, 0x800, 0x1000
_TABLE_BLOCK = 2**16  # chunk table entries checked at a time, to bound the memory it takes

# what decoding needs; the rest of a header may be megabytes of a renderer's metadata
_NEEDED = (
    "channels",
    "compression",
    "displayWindow",
    "lineOrder",
    "pixelAspectRatio",
    "screenWindowCenter",
    "screenWindowWidth",
    "type",
    "tiles",
)


@dataclass(frozen=True, slots=True)
class Chunks:
    """A part's chunks: `count` table entries from byte `table_at` on.

    They lie in rows of `across` chunks (1 unless tiled), each `height` scanlines high; those of
    smaller versions of the image, if there are any, follow. `number` is the part's in a multi-part
    file, whose chunks say so, else None. `header` begins a file with some of these chunks.
    """

    window: Window
    table_at: int
    count: int
    height: int
    number: int | None
    header: bytes
    across: int = 1
    tiled: bool = False

    @property
    def rows(self) -> int:
        """Rows of chunks in the image, at its full size."""
        return -(-(self.window[3] - self.window[1] + 1) // self.height)

    @property
    def head(self) -> int:
        """Bytes before a chunk's pixels, the last four of which say how many those are."""
        return (0 if self.number is None else 4) + (20 if self.tiled else 8)

    def table(self, data: Buffer) -> NDArray[np.uint64]:
        """Each chunk's position in the file."""
        return np.frombuffer(data, "<u8", self.count, self.table_at)

    def lines_of(self, first: int, last: int) -> slice:
        """The scanlines, from 0 on, of the rows `first` to before `last`."""
        height = self.window[3] - self.window[1] + 1
        return slice(first * self.height, min(last * self.height, height))

    def places(self, data: Buffer, first: int, last: int) -> list[tuple[int, int]]:
        """Where the pixels of the chunks in these rows begin, and how many bytes they are."""
        size_before = struct.Struct("<i").unpack_from
        begins = self.table(data)[first * self.across : last * self.across] + np.uint64(self.head)
        return [(begin, size_before(data, begin - 4)[0]) for begin in begins.tolist()]

    def cut(self, data: Buffer, rows: Sequence[int]) -> bytes:
        """A single-part EXR file of these rows of chunks, in ascending order, without gaps.

        Raises DamagedImageError when they hold other tiles than they should.
        """
        x0, y0, x1, _ = self.window
        lines = self.lines_of(rows[0], rows[-1] + 1)
        gaps = (rows[-1] + 1 - rows[0] - len(rows)) * self.height
        y0 += lines.start
        window = struct.pack("<4i", x0, y0, x1, y0 + lines.stop - lines.start - gaps - 1)
        pieces: list[bytes | Buffer] = []
        sizes = []
        places = self.places(data, rows[0], rows[-1] + 1)
        for index, row in enumerate(rows):
            for column in range(self.across):
                begin, size = places[(row - rows[0]) * self.across + column]
                if self.tiled:
                    if struct.unpack_from("<4i", data, begin - 20) != (column, row, 0, 0):
                        raise DamagedImageError(
                            "a chunk holds another tile than its table entry says"
                        )
                    head = struct.pack("<5i", column, index, 0, 0, size)
                else:
                    head = struct.pack("<2i", y0 + index * self.height, size)
                pieces += (head, data[begin : begin + size])
                sizes.append(len(head) + size)
        begin = len(self.header) + len(_WINDOW) + len(window) + 1 + 8 * len(sizes)
        starts = np.cumsum([begin, *sizes[:-1]], dtype="<u8")
        return b"".join((self.header, _WINDOW, window, b"\0", starts.tobytes(), *pieces))


_WINDOW = b"dataWindow\0box2i\0" + struct.pack("<i", 16)


def header_of(raw: RawPart, *, tiled: bool) -> bytes:
    """The header of a single-part file with this part's pixels, without data window and end."""
    pieces = [struct.pack("<2I", MAGIC, 2 | LONG_NAMES | (TILED if tiled else 0))]
    for name in _NEEDED:
        if name in raw.values:
            value = bytes(raw.values[name])
            if name == "tiles":
                value = value[:8] + b"\0"  # the image alone, without smaller versions
            start = f"{name}\0{raw.types[name]}\0".encode()
            pieces += (start, struct.pack("<i", len(value)), value)
    return b"".join(pieces)


def check(data: Buffer, chunks: Chunks, first: int) -> None:
    """Every chunk must lie in the file, from byte `first` on, and be what its entry promises.

    Raises DamagedImageError.
    """
    table = chunks.table(data)
    missing = table.size - int(np.count_nonzero(table))
    if missing:
        raise DamagedImageError(
            f"the image is incomplete: {missing} of {table.size} chunks were never written",
            fix="wait until the renderer has finished, or render again",
        )
    total = 0
    for start in range(0, table.size, _TABLE_BLOCK):
        total += _check_block(data, chunks, table[start : start + _TABLE_BLOCK], start, first)
    # or a small file could be cut into large ones
    if total > len(data) - first:
        raise DamagedImageError("the image is damaged: its chunks overlap")


def _check_block(
    data: Buffer, chunks: Chunks, table: NDArray[np.uint64], start: int, first: int
) -> int:
    """How many bytes these chunks take; `table` holds the entries from `start` on."""
    head = chunks.head
    if int(table.min()) < first or int(table.max()) > len(data) - head:
        raise truncated("or its chunk table is damaged")
    offsets = table.astype(np.int64)
    view = np.frombuffer(data, np.uint8)

    def field(at: int) -> NDArray[np.int64]:
        picked = view[offsets[:, None] + np.arange(at, at + 4)]
        return np.ascontiguousarray(picked).view("<i4")[:, 0].astype(np.int64)

    sizes = field(head - 4)
    if int(sizes.min()) < 0 or int((offsets + head + sizes).max()) > len(data):
        raise truncated("or its chunk sizes are damaged")
    if chunks.number is not None and not (field(0) == chunks.number).all():
        raise DamagedImageError("a chunk belongs to another part than its table says")
    if not chunks.tiled:
        lines = start + np.arange(table.size, dtype=np.int64)
        if not (field(head - 8) == chunks.window[1] + chunks.height * lines).all():
            raise DamagedImageError("a chunk holds other scanlines than its table entry says")
    return head * table.size + int(sizes.sum())
