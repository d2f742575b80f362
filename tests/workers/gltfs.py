"""glTF files that tests write by hand: quads, textures of a few texels."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

KINDS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class Writer:
    """Collects a glTF's parts; `write` makes the file."""

    def __init__(self) -> None:
        self.data = b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}}

    def add(self, key: str, item: Any) -> int:
        items = self.json.setdefault(key, [])
        items.append(item)
        return len(items) - 1

    def array(self, values: Any, kind: str = "float32", **terms: Any) -> int:
        array = np.asarray(values, kind)
        if array.ndim == 3:
            array = array.transpose(0, 2, 1)  # matrices are stored by columns
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.data += array.tobytes()
        accessor = {
            "bufferView": self.add("bufferViews", view),
            "componentType": KINDS[kind],
            "count": len(array),
            "type": SHAPES[array.shape[1:]],
        }
        return self.add("accessors", {**accessor, **terms})

    def texture(self, pixels: Any, **sampler: int) -> dict[str, int]:
        """8-bit pixels (H, W, 3 or 4) as an embedded PNG."""
        image = self.add("images", {"uri": data_uri(pixels)})
        texture = {"source": image, "sampler": self.add("samplers", sampler)}
        return {"index": self.add("textures", texture)}

    def quad(self, material: Any = None, x: float = 0, **attributes: Any) -> None:
        """x - 1 … x + 1 by -1 … 1 in the plane y = 0, facing up; u to the right, v down."""
        corners = [[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]
        arrays: dict[str, Any] = {
            "POSITION": corners,
            "NORMAL": [[0, 1, 0]] * 4,
            "TEXCOORD_0": [[0, 1], [1, 1], [1, 0], [0, 0]],
        }
        primitive: dict[str, Any] = {
            "attributes": {k: self.array(v) for k, v in (arrays | attributes).items()},
            "indices": self.array([0, 1, 2, 0, 2, 3], "uint16"),
        }
        if material is not None:
            primitive["material"] = self.add("materials", material)
        mesh = self.add("meshes", {"primitives": [primitive]})
        self.add("nodes", {"mesh": mesh, "translation": [x, 0, 0]})

    def write(self, path: Path) -> Path:
        """As .gltf with everything inside, or as .glb."""
        buffer: dict[str, Any] = {"byteLength": len(self.data)}
        self.json["buffers"] = [buffer]
        if path.suffix == ".gltf":
            text = base64.b64encode(self.data).decode()
            buffer["uri"] = f"data:application/octet-stream;base64,{text}"
            path.write_text(json.dumps(self.json))
            return path
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        binary = self.data + b"\0" * (-len(self.data) % 4)
        chunks = [
            len(chunk).to_bytes(4, "little") + kind + chunk
            for kind, chunk in ((b"JSON", text), (b"BIN\0", binary))
        ]
        size = 12 + sum(map(len, chunks))
        head = b"glTF" + (2).to_bytes(4, "little") + size.to_bytes(4, "little")
        path.write_bytes(head + b"".join(chunks))
        return path


def data_uri(pixels: Any) -> str:
    return "data:image/png;base64," + base64.b64encode(png(pixels)).decode()


def png(pixels: Any) -> bytes:
    data = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(data, "PNG")
    return data.getvalue()


def metal_rough(**terms: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": terms}


def linear(byte: Any) -> Any:
    """Of an sRGB byte: Pillow's and ours are not asked (IEC 61966-2-1, inverted by search)."""
    grid = np.linspace(0, 1, 100_001)
    coded = np.where(grid <= 0.0031308, 12.92 * grid, 1.055 * grid ** (1 / 2.4) - 0.055)
    return np.interp(np.asarray(byte) / 255, coded, grid)
