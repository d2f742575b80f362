"""Reads the attributes of EXR headers: bounded, whatever the bytes say.

Layout: "OpenEXR File Layout", openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deepshade.errors import DamagedImageError, ImageError
from deepshade.exr.limits import Limits

Buffer = memoryview

MAX_ATTRIBUTES = 4_000  # of all parts; the busiest production files have a few hundred
MAX_TEXTS = 4_000  # in one attribute
_TYPES = ("uint", "half", "float")


@dataclass(slots=True)
class RawPart:
    """One part's header while it is being read.

    `types` and `values` hold every attribute, `attributes` what those of known types mean;
    `channels` maps names to "half", "float" or "uint".
    """

    values: dict[str, Buffer] = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    channels: dict[str, str] = field(default_factory=dict)
    subsampled: set[str] = field(default_factory=set)


class Cursor:
    """A place in the bytes that can't run past their end."""

    def __init__(self, data: Buffer, at: int) -> None:
        self.data = data
        self.at = at

    def skip(self, count: int) -> int:
        """Moves on by `count` bytes, which must be there; where it was."""
        start = self.at
        if count < 0 or count > len(self.data) - start:
            raise truncated("within the header")
        self.at = start + count
        return start

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """The next values, in a layout of `struct`."""
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def peek(self) -> int:
        """The next byte, which stays the next."""
        if self.at >= len(self.data):
            raise truncated("within the header")
        return self.data[self.at]

    def name(self) -> str:
        """The next text, which a zero byte ends."""
        window = bytes(self.data[self.at : self.at + 256])
        end = window.find(b"\0")
        if end < 0:
            if len(window) < 256:
                raise truncated("within the header")
            raise DamagedImageError("the header holds a name longer than 255 bytes")
        self.at += end + 1
        return window[:end].decode("utf-8", "replace")

    def table(self, count: int) -> int:
        """Where the chunk table of that many entries begins, which must be here."""
        if count > (len(self.data) - self.at) // 8:
            raise truncated("within the chunk table")
        return self.skip(8 * count)


def read_part(cursor: Cursor, limits: Limits, most: int) -> RawPart:
    """One part's header, which may have at most `most` attributes."""
    raw = RawPart()
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
        raw.values[name] = value
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
        f"the header has over {MAX_ATTRIBUTES:,} attributes", fix="save it without metadata"
    )


def _read_channels(value: Buffer, raw: RawPart, limits: Limits) -> None:
    cursor = Cursor(value, 0)
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


def truncated(where: str) -> DamagedImageError:
    """The error for bytes that end too early."""
    return DamagedImageError(f"the image is truncated, {where}", fix="send the whole file again")


def _text(value: Buffer) -> str:
    return bytes(value).decode("utf-8", "replace")


def _texts(value: Buffer) -> list[str]:
    cursor = Cursor(value, 0)
    out: list[str] = []
    while cursor.at < len(value):
        if len(out) == MAX_TEXTS:
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
