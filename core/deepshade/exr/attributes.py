"""Reads the attributes of EXR headers: bounded, whatever the bytes say.

Layout: "OpenEXR File Layout", openexr.com/en/latest/OpenEXRFileLayout.html.
"""

from __future__ import annotations

import struct
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
    """A reading position in bytes; raises DamagedImageError instead of running past their end."""

    def __init__(self, data: Buffer, at: int) -> None:
        self.data = data
        self.at = at

    def skip(self, count: int, where: str = "header") -> int:
        """The position before it moves on by `count` bytes, which lie in `where`."""
        start = self.at
        if count < 0 or count > len(self.data) - start:
            raise truncated(f"within the {where}")
        self.at = start + count
        return start

    def unpack(self, layout: str) -> tuple[Any, ...]:
        """The next values, in a layout of `struct`."""
        return struct.unpack_from(layout, self.data, self.skip(struct.calcsize(layout)))

    def name(self) -> str:
        """The next zero-terminated text of up to 255 bytes."""
        window = bytes(self.data[self.at : self.at + 256])
        end = window.find(b"\0")
        if end < 0:
            if len(window) < 256:
                raise truncated("within the header")
            raise DamagedImageError("the header holds a name longer than 255 bytes")
        self.at += end + 1
        return window[:end].decode("utf-8", "replace")


def read_part(cursor: Cursor, limits: Limits, limit: int) -> RawPart:
    """One part's header of at most `limit` attributes."""
    raw = RawPart()
    for _ in range(limit + 1):
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
            continue
        try:
            meant = _value(kind, value)
        except (struct.error, ValueError):
            raise DamagedImageError(f"the header attribute '{name}' is no valid {kind}") from None
        if meant is not None:
            raw.attributes[name] = meant
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


def _value(kind: str, value: Buffer) -> Any:
    """An attribute of a known type; None for another. Raises what struct and numpy raise."""
    if layout := _LAYOUTS.get(kind):
        found = struct.unpack(layout, value)
        return found[0] if len(found) == 1 else found
    if matrix := _MATRICES.get(kind):
        return np.frombuffer(bytes(value), matrix[0]).reshape(matrix[1:])
    if kind == "string":
        return bytes(value).decode("utf-8", "replace")
    return _texts(value) if kind == "stringvector" else None


def _texts(value: Buffer) -> list[str]:
    cursor = Cursor(value, 0)
    out: list[str] = []
    while cursor.at < len(value):
        if len(out) == MAX_TEXTS:
            raise ValueError
        (size,) = cursor.unpack("<i")
        start = cursor.skip(size)
        out.append(bytes(value[start : start + size]).decode("utf-8", "replace"))
    return out


_LAYOUTS = {
    "int": "<i",
    "float": "<f",
    "double": "<d",
    "compression": "<B",
    "lineOrder": "<B",
    "envmap": "<B",
    **{f"v{count}{kind}": f"<{count}{kind}" for count in (2, 3) for kind in "ifd"},
    "box2i": "<4i",
    "box2f": "<4f",
    "tiledesc": "<2IB",
}
_MATRICES = {f"m{n}{n}{kind}": (f"<{kind}", n, n) for n in (3, 4) for kind in "fd"}
