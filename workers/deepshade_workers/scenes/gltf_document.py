"""The container of glTF 2.0 and GLB files: JSON, buffers, accessors.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 and 4.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import SceneError
from deepshade_workers.scenes.resources import Resources

TYPES: dict[int, Any] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
SHAPES: dict[str, tuple[int, ...]] = {
    "SCALAR": (),
    "VEC2": (2,),
    "VEC3": (3,),
    "VEC4": (4,),
    "MAT4": (4, 4),
}


@dataclass
class Document:
    """An open file: its JSON, its buffers, and the `resources` beside it."""

    json: Mapping[str, Any]
    resources: Resources
    binary: bytes = b""
    buffers: dict[int, bytes] = field(default_factory=dict)

    def view(self, index: int) -> tuple[bytes, Mapping[str, Any]]:
        """The bytes of a buffer view, and what else is said of it."""
        view = self.json["bufferViews"][index]
        number = view["buffer"]
        if number not in self.buffers:
            uri = self.json["buffers"][number].get("uri")
            self.buffers[number] = self.binary if uri is None else self.resources.read(uri)
        start = view.get("byteOffset", 0)
        found = self.buffers[number][start : start + view["byteLength"]]
        if len(found) < view["byteLength"]:
            raise ValueError(f"its buffer {number} is too short")
        return found, view

    def accessor(self, index: int) -> NDArray[Any]:
        """The values of an accessor, (count, …): floats where they are normalised integers."""
        accessor = self.json["accessors"][index]
        kind = np.dtype(TYPES[accessor["componentType"]]).newbyteorder("<")
        count, shape = accessor["count"], SHAPES[accessor["type"]]
        if "bufferView" in accessor:
            data, view = self.view(accessor["bufferView"])
            start = accessor.get("byteOffset", 0)
            values = _strided(data, start, view.get("byteStride"), count, shape, kind)
        else:
            values = np.zeros((count, *shape), kind)
        if "sparse" in accessor:
            values = self._replaced(values, accessor["sparse"])
        if accessor.get("normalized"):
            return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1)
        return values

    def _replaced(self, values: NDArray[Any], sparse: Mapping[str, Any]) -> NDArray[Any]:
        where, what = sparse["indices"], sparse["values"]
        count = sparse["count"]
        places, _ = self.view(where["bufferView"])
        kind = np.dtype(TYPES[where["componentType"]]).newbyteorder("<")
        rows = _strided(places, where.get("byteOffset", 0), None, count, (), kind)
        data, _ = self.view(what["bufferView"])
        found = values.copy()
        start = what.get("byteOffset", 0)
        found[rows] = _strided(data, start, None, count, values.shape[1:], values.dtype)
        return found


def open_document(path: Path) -> Document:
    """Read a file's JSON and, of a GLB, its buffer; other buffers are read when they are needed.

    Raises:
        SceneError: it is of version 1.
        OSError, ValueError: it is damaged.
    """
    data = path.read_bytes()
    resources = Resources(path)
    if data[:4] != b"glTF":
        return Document(json.loads(data.decode("utf-8-sig")), resources)
    if int.from_bytes(data[4:8], "little") == 1:
        raise SceneError(f"{path} is glTF 1", fix="only glTF 2 can be read: export it anew")
    chunks: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(data):
        length = int.from_bytes(data[start : start + 4], "little")
        chunk = data[start + 8 : start + 8 + length]
        if len(chunk) < length:
            raise ValueError("it ends too early")
        chunks.setdefault(data[start + 4 : start + 8], chunk)
        start += 8 + length
    if b"JSON" not in chunks:
        raise ValueError("it is no GLB")
    return Document(json.loads(chunks[b"JSON"]), resources, chunks.get(b"BIN\0", b""))


def _strided(
    data: bytes, start: int, stride: int | None, count: int, shape: tuple[int, ...], kind: Any
) -> NDArray[Any]:
    """(count, *shape) elements, `stride` bytes apart; ValueError beyond the data's end."""
    kind = np.dtype(kind)
    inner = [kind.itemsize * int(np.prod(shape[axis + 1 :])) for axis in range(len(shape))]
    step = stride or kind.itemsize * int(np.prod(shape))
    found: NDArray[Any] = np.ndarray((count, *shape), kind, data, start, (step, *inner))
    # matrices are stored by columns
    return found.swapaxes(1, 2) if len(shape) == 2 else found
