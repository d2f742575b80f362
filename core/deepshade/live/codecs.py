"""Lossless codecs of one plane: what they are called on the wire, and who can do which.

Blosc2 (blosc.org) and HTJ2K (ISO/IEC 15444-15) come with `imagecodecs`, the extra `live`. What is
decoded comes from strangers, so the size that a codec's own header says is compared with the
plane's before anything is allocated.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, cast

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from deepshade.errors import DamagedImageError, DeepshadeError
from deepshade.extras import install_command, installed

Plane = NDArray[Any]
Bytes = bytes | memoryview

CODECS = {"raw": 0, "deflate": 1, "lz4": 2, "zstd": 3, "htj2k": 4}
PICTURES = {"jpeg": 16, "webp": 17}
NAMES = {code: name for name, code in (CODECS | PICTURES).items()}

_DEFLATE_LEVEL = 1
_BLOSC = struct.Struct("<4x3I")  # version, flags; then bytes decoded, of a block, encoded
# J2K: start, SIZ, its length, capabilities, size, origin, tile's size and origin, components
_SIZ = struct.Struct(">HHHH8IHBBB")


@cache
def available() -> tuple[str, ...]:
    """The codecs that this installation has, by how fast they are."""
    more = installed("imagecodecs")
    return tuple(name for name in CODECS if more or name in ("raw", "deflate"))


def encode(plane: Plane, codec: str) -> bytes:
    """A plane (H, W) of float16 or float32 in a codec of `available`, exactly.

    Raises DeepshadeError for a codec that isn't installed.
    """
    plane = np.ascontiguousarray(plane).astype(plane.dtype.newbyteorder("<"), copy=False)
    if codec == "raw":
        return plane.tobytes()
    if codec == "deflate":
        return bytes(isal_zlib.compress(_split(plane), _DEFLATE_LEVEL))
    if codec == "htj2k":
        return bytes(_library().htj2k_encode(_bits(plane), reversible=True))
    return bytes(
        _library().blosc2_encode(
            plane.tobytes(), level=1, compressor=codec, shuffle=1, typesize=plane.itemsize
        )
    )


def decode(data: Bytes, codec: str, kind: np.dtype[Any], shape: tuple[int, int]) -> Plane:
    """The plane (H, W) of a `kind` of float that `encode` was given; may share `data`'s memory.

    Raises DamagedImageError for bytes that are none, DeepshadeError for a codec that isn't there.
    """
    size = kind.itemsize * shape[0] * shape[1]
    try:
        if codec == "raw":
            return np.frombuffer(data, kind).reshape(shape)
        if codec == "deflate":
            return _joined(_inflated(data, size), kind, shape)
        if codec == "htj2k":
            return _from_htj2k(data, kind, shape)
        return _from_blosc(data, size).view(kind).reshape(shape)
    except (DeepshadeError, MemoryError):
        raise
    except Exception as error:  # libraries raise what they like
        raise _damaged(codec, str(error)[:200]) from None


def _from_htj2k(data: Bytes, kind: np.dtype[Any], shape: tuple[int, int]) -> Plane:
    start, mark, _, _, width, height, *rest = _SIZ.unpack_from(data)
    left, top, tile_width, tile_height, _, _, components, depth, _, _ = rest
    if (start, mark) != (0xFF4F, 0xFF51) or (left, top, components) != (0, 0, 1):
        raise _damaged("htj2k", "its header is no plane's")
    if (height, width, depth) != (*shape, 8 * kind.itemsize - 1):
        raise _damaged("htj2k", f"{width} x {height}, {depth + 1} bits")
    if tile_width < width or tile_height < height:
        raise _damaged("htj2k", "it has tiles")
    found = np.ascontiguousarray(_library().htj2k_decode(data))
    if found.nbytes != kind.itemsize * shape[0] * shape[1]:
        raise _damaged("htj2k", f"{found.nbytes} bytes")
    return cast(Plane, found.reshape(shape).view(kind))


def _from_blosc(data: Bytes, size: int) -> Plane:
    said, _, encoded = _BLOSC.unpack_from(data)
    if said != size or encoded > len(data):
        raise _damaged("blosc2", f"it says {said} bytes, the plane has {size}")
    out = np.empty(size, np.uint8)
    _library().blosc2_decode(data, out=out)
    return out


def _inflated(data: Bytes, size: int) -> bytes:
    reader = isal_zlib.decompressobj()
    found = bytes(reader.decompress(data, size)) if size else b""
    if len(found) != size or not (reader.eof or _ends(reader)):
        raise _damaged("deflate", f"not {size} bytes")
    return found


def _ends(reader: Any) -> bool:
    """Whether nothing but the checksum was left."""
    return not reader.decompress(reader.unconsumed_tail, 1) and bool(reader.eof)


def _split(plane: Plane) -> bytes:
    return plane.view(np.uint8).reshape(-1, plane.itemsize).T.tobytes()


def _joined(data: bytes, kind: np.dtype[Any], shape: tuple[int, int]) -> Plane:
    split = np.frombuffer(data, np.uint8).reshape(kind.itemsize, -1)
    return np.ascontiguousarray(split.T).view(kind).reshape(shape)


def _bits(plane: Plane) -> Plane:
    return plane.view(np.uint16 if plane.itemsize == 2 else np.uint32)


def _damaged(codec: str, why: str) -> DamagedImageError:
    return DamagedImageError(f"a plane can't be decoded as {codec}: {why}", fix="send it again")


def _library() -> Any:
    if not installed("imagecodecs"):
        raise DeepshadeError("imagecodecs is not installed", fix=install_command("live"))
    import imagecodecs

    return imagecodecs
