"""Uploads that are kept for a while: a picture is sent once and shaded again and again."""

from __future__ import annotations

import hashlib
import re
import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from deepshade.errors import LimitError, nearest
from deepshade_service.problems import Problem
from deepshade_service.uploads import Upload

_MOST = 256  # uploads, however small
_NAME = re.compile(r"[0-9a-f]{32}")


@dataclass(slots=True)
class _Entry:
    files: tuple[Upload, ...]
    used: float
    users: int = 0

    @property
    def size(self) -> int:
        return sum(len(file.data) for file in self.files)


class Kept:
    """At most `room` bytes of uploads, those used last, each until `seconds` after its last use.

    An upload is called by a hash of what it holds, keyed anew by every process: who sends the same
    files gets the same name, and nobody can guess one. Beside them are the samples, the EXR files
    of a folder, called as these are; they are read when they are used. Only for use on the event
    loop, but for `name`.
    """

    def __init__(self, room: int, seconds: float, samples: Path) -> None:
        self._room = room
        self._seconds = seconds
        self._samples = {path.stem: path for path in sorted(samples.glob("*.exr"))}
        self._key = secrets.token_bytes(32)
        self._entries: dict[str, _Entry] = {}  # who was used last is last

    @property
    def bytes(self) -> int:
        """What is kept now."""
        return sum(entry.size for entry in self._entries.values())

    @property
    def samples(self) -> list[str]:
        """The names of the samples."""
        return list(self._samples)

    def name(self, files: Sequence[Upload]) -> str:
        """What an upload of these files is called; this reads all their bytes."""
        digest = hashlib.blake2b(key=self._key, digest_size=16)
        for file in files:
            parts = file.field.encode(), file.filename.encode(), file.data
            for part in parts:
                digest.update(len(part).to_bytes(8, "little"))
                digest.update(part)
        return digest.hexdigest()

    def add(self, name: str, files: Sequence[Upload]) -> None:
        """Keep the files that are called `name`; those used longest ago make room.

        Raises LimitError for more than may be kept at all, Problem 429 where all is in use.
        """
        self.tidy()
        if entry := self._entries.pop(name, None):
            entry.used = time.monotonic()
            self._entries[name] = entry
            return
        entry = _Entry(tuple(files), time.monotonic())
        if entry.size > self._room:
            raise LimitError("kept_bytes", entry.size, self._room)
        idle = [other for other, each in self._entries.items() if not each.users]
        while len(self._entries) >= _MOST or self.bytes + entry.size > self._room:
            if not idle:
                raise Problem(
                    429,
                    "uploads-full",
                    "all kept uploads are in use, and there is no room for another",
                    fix="try again later",
                    headers={"Retry-After": "2"},
                )
            del self._entries[idle.pop(0)]
        self._entries[name] = entry

    @contextmanager
    def use(self, name: str) -> Iterator[list[Upload]]:
        """The files of an upload or of a sample, which stay until the block is left.

        Raises Problem 410 for an upload that isn't kept, 404 for what can't be one.
        """
        self.tidy()
        if name in self._samples:
            path = self._samples[name]
            yield [Upload("", path.name, path.read_bytes())]
            return
        if not _NAME.fullmatch(name):
            close = nearest(name[:100], self._samples)
            raise Problem(
                404,
                "no-upload",
                f"there is no upload or sample '{name[:100]}'",
                fix=f"did you mean '{close}'?" if close else "GET /samples lists the samples",
                samples=self.samples,
            )
        entry = self._entries.pop(name, None)
        if entry is None:
            raise Problem(
                410,
                "upload-gone",
                f"the upload '{name}' is no longer kept (they go {self._seconds / 60:.0f} minutes"
                " after their last use, or when others need the room)",
                fix="send the files again: POST /uploads, or with the request itself",
            )
        self._entries[name] = entry
        entry.users += 1
        try:
            yield list(entry.files)
        finally:
            entry.users -= 1
            entry.used = time.monotonic()

    def tidy(self) -> None:
        """Forget what wasn't used for too long."""
        oldest = time.monotonic() - self._seconds
        old = [n for n, each in self._entries.items() if not each.users and each.used < oldest]
        for name in old:
            del self._entries[name]
