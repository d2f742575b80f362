"""The binary message: a header of 40 bytes, JSON, and planes (docs/streaming.md).

The bytes come from strangers: sizes are compared with what is there before anything is allocated.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import DamagedImageError
from deepshade.exr import Limits
from deepshade.exr.planes import Planes
from deepshade.live import codecs
from deepshade.threads import run_all, thread_count

GBUFFER, ANSWER = 1, 2
CUT, REST = 1, 2

_MAGIC, _VERSION = b"DSLF", 1
_HEAD = struct.Struct("<4s4B4I2d")
_SIZE = struct.Struct("<I")
_TIMES = struct.Struct("<2d")
_MAX_JSON = 2**16
_MAX_TEXT = 1000
_KINDS: dict[str, np.dtype[Any]] = {"half": np.dtype("<f2"), "float": np.dtype("<f4")}
_SHAPES = {2: (2,), 3: (3,), 9: (3, 3), 16: (4, 4)}


class FrameError(DamagedImageError):
    """The bytes are no frame: `str()` says what of it, where."""

    fix = "docs/streaming.md says what a frame is"


@dataclass(frozen=True, slots=True)
class Frame:
    """One binary message. `time` and `sent` are Unix seconds of the sender's clock.

    `about` is its JSON; `blocks` are the planes' compressed bytes, in the order of
    `about["planes"]`, or the one picture for eyes.
    """

    kind: int
    codec: str
    id: int
    width: int
    height: int
    time: float
    sent: float
    about: Mapping[str, Any]
    flags: int = 0
    blocks: Sequence[bytes | memoryview] = field(default=(), repr=False)

    def planes(self) -> dict[str, NDArray[Any]]:
        """Its planes by name, (H, W) float16 or float32, decompressed on several threads.

        Raises DamagedImageError; DeepshadeError where the codec isn't installed.
        """
        names = self.about["planes"]
        found: dict[int, NDArray[Any]] = {}
        shape = self.height, self.width

        def decode(index: int) -> None:
            kind = _KINDS[names[index][1]]
            found[index] = codecs.decode(self.blocks[index], self.codec, kind, shape)

        # what is only looked at, or small, isn't worth handing over
        threads = 1 if self.codec == "raw" or self.width * self.height < 2**16 else thread_count()
        run_all(decode, range(len(names)), threads)
        return {name: found[index] for index, (name, _) in enumerate(names)}

    def picture(self) -> Planes:
        """What a G-buffer's frame holds. Raises what `planes` raises."""
        return Planes(self.planes(), attributes(self.about.get("header", {})))


def pack(
    kind: int,
    id: int,
    planes: Mapping[str, NDArray[Any]],
    about: Mapping[str, Any],
    *,
    codec: str,
    time: float,
    sent: float,
    flags: int = 0,
) -> bytearray:
    """A message of planes (H, W), float16 or float32, all of one size; compressed on threads."""
    height, width = next(iter(planes.values())).shape
    found: dict[str, bytes] = {}

    def encode(name: str) -> None:
        found[name] = codecs.encode(planes[name], codec)

    small = codec == "raw" or width * height < 2**16
    run_all(encode, list(planes), 1 if small else thread_count())
    kinds = {2: "half", 4: "float"}
    listed = [[name, kinds[plane.itemsize]] for name, plane in planes.items()]
    blocks = [found[name] for name in planes]
    head = _head(kind, codec, id, width, height, {"planes": listed, **about}, time, sent, flags)
    return bytearray().join(
        [*head, *(part for block in blocks for part in (_SIZE.pack(len(block)), block))]
    )


def stamp(message: bytearray, *, time: float, sent: float) -> None:
    """Write into a message of `pack` when its picture was made, and when it is sent."""
    _TIMES.pack_into(message, _HEAD.size - _TIMES.size, time, sent)


def pack_picture(
    id: int,
    codec: str,
    content: bytes,
    size: tuple[int, int],
    about: Mapping[str, Any],
    *,
    time: float,
    sent: float,
    flags: int = 0,
) -> bytes:
    """A message of a picture for eyes of `size` (width, height): a JPEG or WebP file."""
    head = _head(ANSWER, codec, id, *size, about, time, sent, flags)
    return b"".join([*head, _SIZE.pack(len(content)), content])


def parse(data: bytes, limits: Limits) -> Frame:
    """The frame in a message; nothing is decompressed. Raises FrameError, LimitError."""
    if len(data) < _HEAD.size:
        raise FrameError(f"a frame begins with {_HEAD.size} bytes, here are {len(data)}")
    magic, version, kind, codec, flags, id_, width, height, size, made, sent = _HEAD.unpack_from(
        data
    )
    if magic != _MAGIC:
        raise FrameError(f"a frame begins with {_MAGIC!r}, not {magic!r}")
    if version != _VERSION:
        raise FrameError(f"version {version} of frames isn't known here, only {_VERSION}")
    if kind not in (GBUFFER, ANSWER) or codec not in codecs.NAMES:
        raise FrameError(f"kind {kind}, codec {codec}: no frame has these")
    if not (math.isfinite(made) and math.isfinite(sent)):
        raise FrameError("the frame's times aren't finite")
    if not width or not height:
        raise FrameError(f"the frame has {width} x {height} pixels")
    limits.check("pixels", width * height)
    if size > min(_MAX_JSON, len(data) - _HEAD.size):
        raise FrameError(f"its JSON of {size} bytes is longer than the frame, or than {_MAX_JSON}")
    end = _HEAD.size + size
    about = _object(data[_HEAD.size : end])
    name = codecs.NAMES[codec]
    view = memoryview(data)
    blocks: list[memoryview] = []
    while end < len(data):
        if end + _SIZE.size > len(data):
            raise FrameError("the frame ends within a plane's size")
        (length,) = _SIZE.unpack_from(data, end)
        end += _SIZE.size + length
        if end > len(data):
            raise FrameError(f"plane {len(blocks)} ends beyond the frame")
        blocks.append(view[end - length : end])
    frame = Frame(kind, name, id_, width, height, made, sent, about, flags, blocks)
    _check(frame, limits)
    return frame


def attributes(header: Mapping[str, Any]) -> dict[str, Any]:
    """A G-buffer's "header" as the attributes of an EXR part. Raises FrameError."""
    found: dict[str, Any] = {}
    for name, value in header.items():
        if isinstance(value, str) and len(value) <= _MAX_TEXT:
            found[name] = value
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found[name] = float(value) if isinstance(value, float) else value
        elif isinstance(value, list) and len(value) in _SHAPES and _numbers(value):
            found[name] = np.array(value, np.float32).reshape(_SHAPES[len(value)])
        else:
            raise FrameError(f"the header's '{name[:60]}' is no number, text, vector or matrix")
    return found


def _head(
    kind: int,
    codec: str,
    id: int,
    width: int,
    height: int,
    about: Mapping[str, Any],
    time: float,
    sent: float,
    flags: int,
) -> tuple[bytes, bytes]:
    text = json.dumps(about, separators=(",", ":"), allow_nan=False).encode()
    if len(text) > _MAX_JSON:
        raise FrameError(f"its JSON has {len(text)} bytes, at most {_MAX_JSON} are allowed")
    code = (codecs.CODECS | codecs.PICTURES)[codec]
    head = _HEAD.pack(_MAGIC, _VERSION, kind, code, flags, id, width, height, len(text), time, sent)
    return head, text


def _object(text: bytes) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise ValueError(f"{word} is no JSON")

    try:
        found = json.loads(text.decode(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise FrameError(f"the frame's JSON can't be read: {str(error)[:100]}") from None
    if not isinstance(found, dict):
        raise FrameError("the frame's JSON is no object")
    return found


def _check(frame: Frame, limits: Limits) -> None:
    """Raises where the JSON and the blocks contradict each other, or a limit is passed."""
    if frame.codec in codecs.PICTURES:
        if frame.kind != ANSWER or len(frame.blocks) != 1:
            raise FrameError(f"{frame.codec} is for answers, one block each")
        return
    planes = frame.about.get("planes")
    listed = isinstance(planes, list) and all(
        isinstance(each, list)
        and len(each) == 2
        and isinstance(each[0], str)
        and 0 < len(each[0]) <= 255
        and each[1] in _KINDS
        for each in planes
    )
    if not planes or not listed:
        raise FrameError('"planes" must be a list of [name, "half" or "float"]')
    planes = cast(list[tuple[str, str]], planes)
    limits.check("channels", len(planes))
    if len({name for name, _ in planes}) != len(planes):
        raise FrameError("two planes have one name")
    if len(planes) != len(frame.blocks):
        raise FrameError(f"{len(planes)} planes are listed, {len(frame.blocks)} are there")
    pixels = frame.width * frame.height
    sizes = [_KINDS[kind].itemsize * pixels for _, kind in planes]
    limits.check("decoded_bytes", sum(sizes))
    if frame.codec == "raw":
        for (name, _), size, block in zip(planes, sizes, frame.blocks, strict=True):
            if len(block) != size:
                raise FrameError(f"plane '{name[:60]}' has {len(block)} bytes, it must be {size}")
    for key in ("header", "settings"):
        if not isinstance(frame.about.get(key, {}), dict):
            raise FrameError(f'"{key}" must be an object')


def _numbers(values: Sequence[Any]) -> bool:
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
