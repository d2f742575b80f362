"""Pictures for tev and HDRView, which listen for the same packets on TCP (port 14158).

Packets are little-endian: a u32 of the whole length, a byte that says what it is, a byte whether to
come to the front, and texts that end with 0. A whole frame goes in one packet, all channels
behind each other: <https://github.com/Tom94/tev/blob/master/src/Ipc.cpp>.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade_client.exceptions import ClientError

PORT = 14158
_CREATE, _UPDATE = 4, 6
_TIMEOUT = 5.0


class Viewer:
    """A connection to a viewer; one image by name, made anew where its size changes."""

    def __init__(self, address: str, name: str) -> None:
        self._address, self._name = address, name
        self._socket: socket.socket | None = None
        self._made: object = None

    def show(self, planes: Mapping[str, NDArray[Any]]) -> None:
        """Replace the image by planes (H, W). Raises ClientError where no viewer listens."""
        block = np.stack([np.asarray(plane, "<f4") for plane in planes.values()])
        _, height, width = block.shape
        names = [name.encode() for name in planes]
        made = names, width, height
        try:
            if self._socket is None:
                host, _, port = self._address.partition(":")
                where = host or "127.0.0.1", int(port or PORT)
                self._socket = socket.create_connection(where, _TIMEOUT)
            if made != self._made:
                self._send(create(self._name, names, width, height))
                self._made = made
            self._send(update(self._name, names, block))
        except (OSError, ValueError) as error:
            self.close()
            raise ClientError(
                f"no viewer listens at {self._address}: {error}",
                fix=f"start tev or HDRView first, and name it as host:{PORT}",
            ) from error

    def close(self) -> None:
        """Close the connection; the image stays."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._made = None, None

    def _send(self, packet: bytes) -> None:
        assert self._socket is not None, "it was opened"
        self._socket.sendall(packet)


def create(name: str, channels: list[bytes], width: int, height: int) -> bytes:
    """The packet that makes an image of these channels."""
    sizes = struct.pack("<3i", width, height, len(channels))
    return _packet(_CREATE, name, sizes + b"".join(each + b"\0" for each in channels))


def update(name: str, channels: list[bytes], block: NDArray[np.float32]) -> bytes:
    """The packet that fills an image with a block (C, H, W)."""
    count, height, width = block.shape
    names = b"".join(each + b"\0" for each in channels)
    body = struct.pack("<i", count) + names + struct.pack("<4i", 0, 0, width, height)
    offsets = [index * width * height for index in range(count)]
    body += struct.pack(f"<{2 * count}q", *offsets, *([1] * count))
    return _packet(_UPDATE, name, body + block.tobytes())


def _packet(kind: int, name: str, body: bytes) -> bytes:
    inside = struct.pack("<2B", kind, 1) + name.encode() + b"\0" + body
    return struct.pack("<I", len(inside) + 4) + inside
