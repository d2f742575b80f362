"""Data sets that are sent: file by file, each whole or not there, within limits."""

from __future__ import annotations

import asyncio
import re
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from deepshade.bundles import check_name
from deepshade.errors import ConfigError, DataError, LimitError
from deepshade.files import replacing, sha256
from deepshade.manifest import NAME, Manifest

_FILE = re.compile(r"manifest\.json|shard-\d{5,9}\.safetensors|environments/[0-9a-f]{64}\.exr")
MAX_FILES = 10_000


class Uploads:
    """The uploads below a folder, of `limit` bytes in all."""

    def __init__(self, folder: Path, limit: int) -> None:
        self._root, self._limit = folder, limit
        self._held = 0  # bytes that are arriving

    def folder(self, name: str) -> Path:
        """A complete upload's. Raises DataError for another."""
        check_name(name)
        path = self._root / name
        if not (path / NAME).is_file():
            raise DataError(
                f"there is no complete upload {name!r}",
                fix=f"send its shards first and {NAME} last: PUT /data/{name}/<file>",
            )
        manifest = Manifest.read(path)
        missing = [shard.file for shard in manifest.shards if not (path / shard.file).is_file()]
        if missing:
            raise DataError(
                f"the upload {name!r} lacks {', '.join(missing[:5])}", fix="send it too"
            )
        return path.resolve()

    def describe(self, name: str) -> dict[str, Any]:
        """Its files with sizes and hashes, for whoever goes on with sending."""
        check_name(name)
        folder = self._root / name
        paths = sorted(path for path in folder.rglob("*") if path.is_file() and not _partial(path))
        return {
            "name": name,
            "files": [
                {
                    "file": str(path.relative_to(folder)),
                    "bytes": path.stat().st_size,
                    "sha256": sha256(path),
                }
                for path in paths
            ],
        }

    async def receive(self, name: str, file: str, chunks: AsyncIterator[bytes]) -> dict[str, Any]:
        """Write one file. Raises ConfigError for a name that no data set has, and LimitError."""
        check_name(name)
        if not _FILE.fullmatch(file):
            raise ConfigError(
                "file",
                detail=f"a data set has no file {file[:100]!r}, only {NAME}, "
                "shard-00000.safetensors and environments/<sha256>.exr",
            )
        path = self._root / name / file
        path.parent.mkdir(parents=True, exist_ok=True)
        if len(list(path.parent.iterdir())) >= MAX_FILES:
            raise LimitError("files", MAX_FILES + 1, MAX_FILES)
        used = await asyncio.to_thread(self._used)
        size = 0
        try:
            with replacing(path) as temporary, temporary.open("wb") as out:
                async for chunk in chunks:
                    size += len(chunk)
                    self._held += len(chunk)
                    if used + self._held > self._limit:
                        raise LimitError("upload_bytes", used + self._held, self._limit)
                    await asyncio.to_thread(out.write, chunk)
        finally:
            self._held -= size
        return {"name": name, "file": file, "bytes": size}

    def remove(self, name: str) -> bool:
        """Delete an upload; whether there was one."""
        check_name(name)
        there = (self._root / name).is_dir()
        shutil.rmtree(self._root / name, ignore_errors=True)
        return there

    def _used(self) -> int:
        files = (path for path in self._root.rglob("*") if not _partial(path))
        return sum(path.stat().st_size for path in files if path.is_file())


def _partial(path: Path) -> bool:
    return path.name.startswith(".")
