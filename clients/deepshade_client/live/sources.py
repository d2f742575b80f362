"""Where pictures come from: sequences, watched folders, and processes that write frames."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from deepshade import exr, live
from deepshade.errors import ImageError
from deepshade_client.exceptions import ClientError
from deepshade_client.live.pictures import Picture, of_frame, read_picture
from deepshade_client.sequences import View

_SIZE = struct.Struct("<I")
_MOST = 2**28  # bytes of a frame from a process
_KEPT = 2**30  # bytes of decoded pictures that a loop keeps
_LOOK = 0.1  # seconds between looks at a watched folder
_PATIENCE = 20.0  # seconds until a file that stays half-written is said to be


@dataclass(frozen=True, slots=True)
class Reading:
    """How files are read: what the effects need, and what else says where it is."""

    needs: Collection[str]
    mapping: Mapping[str, str] | None = None
    profile: str | None = None

    def __call__(self, files: Sequence[Path], name: str, number: int | None) -> Picture:
        """The picture in these files of one view. Raises ImageError."""
        found = read_picture(
            files, self.needs, mapping=self.mapping, profile=self.profile, name=name, number=number
        )
        return found


async def sequence(
    views: Sequence[View], read: Reading, *, rate: float | None = None, loop: bool = False
) -> AsyncIterator[Picture]:
    """The pictures of views, one after the other; at a `rate` a second where that is given.

    A `loop` begins anew at the end, and keeps what was decoded, up to a GiB. Raises ImageError.
    """
    kept: dict[int, Picture] = {}
    size, first, count = 0, time.monotonic(), 0
    while True:
        for index, view in enumerate(views):
            picture = kept.get(index)
            if picture is None:
                picture = await asyncio.to_thread(read, view.files, view.name, view.frame)
                size += sum(plane.nbytes for plane in picture.planes.values())
                if loop and size < _KEPT:
                    kept[index] = picture
            if rate:
                await asyncio.sleep(max(0.0, first + count / rate - time.monotonic()))
            count += 1
            yield replace(picture, made=time.time(), cut=index == 0 and count > 1)
        if not loop or not views:
            return


async def watched(
    folder: Path, read: Reading, told: Callable[[str], None], *, there: bool = False
) -> AsyncIterator[Picture]:
    """Pictures as EXR files appear in a folder or change; a half-written one waits.

    Those that are `there` at the beginning count too, if wanted. Raises ImageError where the
    folder is gone.
    """
    seen: dict[Path, tuple[int, int]] = {}
    before: dict[Path, tuple[int, int]] = {}
    waiting: dict[Path, float] = {}
    if not there:
        seen = _states(folder)
    while True:
        states = await asyncio.to_thread(_states, folder)
        for path in sorted(states):
            if seen.get(path) == states[path]:
                continue
            if before.get(path) != states[path]:
                continue  # it still grows; or is new, and is looked at once more
            try:
                picture = await asyncio.to_thread(read, [path], path.stem, None)
            except ImageError as error:
                since = waiting.setdefault(path, time.monotonic())
                if time.monotonic() - since > _PATIENCE:
                    told(f"{path} stays unreadable: {error}")
                    seen[path] = states[path]
                continue
            waiting.pop(path, None)
            seen[path] = states[path]
            yield replace(picture, made=path.stat().st_mtime if path.exists() else None)
        before = states
        await asyncio.sleep(_LOOK)


async def piped(stream: BinaryIO, told: Callable[[str], None]) -> AsyncIterator[Picture]:
    """Pictures that a process writes: each a frame (docs/streaming.md) behind its length, a u32.

    Ends where the stream does. Raises ClientError for anything else.
    """
    count = 0
    while True:
        head = await asyncio.to_thread(_exactly, stream, _SIZE.size)
        if not head:
            return
        (size,) = _SIZE.unpack(head.ljust(_SIZE.size, b"\0"))
        if len(head) < _SIZE.size or size > _MOST:
            raise ClientError(
                f"frame {count + 1} from the renderer doesn't begin with its length, 4 bytes",
                fix="docs/streaming.md says how frames are written to a pipe",
            )
        body = await asyncio.to_thread(_exactly, stream, size)
        if len(body) < size:
            told(f"the renderer stopped within frame {count + 1}")
            return
        count += 1
        try:
            frame = await asyncio.to_thread(live.parse, body, exr.Limits())
            picture = await asyncio.to_thread(of_frame, frame, f"frame.{count:04d}", count)
        except ImageError as error:
            raise ClientError(f"frame {count} from the renderer: {error}", fix=error.fix) from error
        yield picture


def _exactly(stream: BinaryIO, size: int) -> bytes:
    """`size` bytes, or what is left."""
    parts: list[bytes] = []
    while size and (part := stream.read(size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _states(folder: Path) -> dict[Path, tuple[int, int]]:
    """Every EXR file's size and time of change. Raises ImageError."""
    found: dict[Path, tuple[int, int]] = {}
    try:
        for path in folder.iterdir():
            if path.suffix.lower() == ".exr" and not path.name.startswith("."):
                try:
                    state: Any = path.stat()
                except FileNotFoundError:
                    continue  # renamed meanwhile
                found[path] = state.st_size, state.st_mtime_ns
    except OSError as error:
        raise ImageError(f"can't look into {folder}: {error.strerror}") from error
    return found
