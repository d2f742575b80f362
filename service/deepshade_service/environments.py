"""The environment maps that this service knows, and what is prepared of them in memory."""

from __future__ import annotations

import asyncio
import logging
import re
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import pictures
from deepshade.effects import SETTINGS
from deepshade.environments import SUFFIXES, Environment, Prepared, read_environment, sky
from deepshade.environments.hdr import MAGIC
from deepshade.errors import DeepshadeError, nearest
from deepshade.exr import Limits
from deepshade.files import replacing
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

DEFAULT = str(SETTINGS["environment"].default)  # generated: it is there without a folder
SHARE = 0.25  # prepared maps may take so much of --memory, on top of it; one is always kept
MAX_MAPS = 1024  # that uploads may add up to

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_THUMBNAIL = 64  # rows
_GREY = 0.35  # what a map's mean is shown as


@dataclass(frozen=True, slots=True)
class _File:
    """A map's file as it was when it was read; None is generated."""

    path: Path | None
    state: tuple[int, int, int]

    @classmethod
    def of(cls, path: Path | None) -> _File:
        """As it is now: when it was changed, its size, and which file it is."""
        if path is None:
            return cls(None, (0, 0, 0))
        try:
            found = path.stat()
        except OSError:
            return cls(path, (0, 0, 0))
        return cls(path, (found.st_mtime_ns, found.st_size, found.st_ino))


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of a map since it was last read."""

    file: _File
    sha256: str
    shape: tuple[int, int]
    thumbnail: bytes


class Environments:
    """Maps by name: the files of a folder, and a generated sky.

    Each is read and prepared when it is first asked for, and again when its file has changed.
    What is prepared is kept by its hash, within `memory` bytes; of others the one used longest
    ago goes. One is prepared at a time. Only for use on the event loop; what blocks is done in
    threads.
    """

    def __init__(self, folder: Path | None, limits: Limits, memory: int) -> None:
        self.folder = folder
        self._limits = limits
        self._memory = memory
        self._preparing = asyncio.Lock()
        self._known: dict[str, _Known] = {}
        self._prepared: OrderedDict[str, Prepared] = OrderedDict()  # by sha256
        self._loading: dict[str, asyncio.Task[Prepared]] = {}

    @property
    def held(self) -> int:
        """Bytes of what is prepared."""
        return sum(prepared.bytes for prepared in self._prepared.values())

    def names(self) -> list[str]:
        """All maps, by name."""
        return sorted({DEFAULT, *self._files()})

    def check(self, name: str, status: int = 422) -> str:
        """The name, if there is such a map; else a Problem with the nearest."""
        names = self.names()
        if name not in names:
            close = nearest(name[:100], names)
            raise Problem(
                status,
                "unknown-environment",
                f"there is no environment '{name[:100]}'",
                fix=f"did you mean '{close}'?" if close else "GET /environments lists them",
                environments=names[:200],
            )
        return name

    async def get(self, name: str) -> Prepared:
        """The map, prepared. Who asks meanwhile waits for that one.

        Raises Problem 422 for an unknown name, and what `read_environment` raises.
        """
        self.check(name)
        known = self._current(name)
        if known is not None and known.sha256 in self._prepared:
            self._prepared.move_to_end(known.sha256)
            return self._prepared[known.sha256]
        if name not in self._loading:
            self._loading[name] = asyncio.create_task(self._load(name))
        return await asyncio.shield(self._loading[name])

    async def add(self, name: str, data: bytes) -> dict[str, Any]:
        """Take a map into the folder, and prepare it. A map of that name is replaced.

        Raises Problem 422 for a name that is none, and what `read_environment` raises.
        """
        if not _NAME.fullmatch(name) or name == DEFAULT:
            raise Problem(
                422,
                "bad-parameter",
                f"a map can't be called '{name[:100]}'",
                fix=f"use up to 64 letters, digits, '.', '_' and '-', and not '{DEFAULT}'",
            )
        if name not in self.names() and len(self.names()) >= MAX_MAPS:
            raise Problem(422, "too-many-environments", f"there are {MAX_MAPS} maps already")
        async with self._preparing:
            environment = await asyncio.to_thread(read_environment, data, name, self._limits)
            file = await asyncio.to_thread(self._write, name, data)
            await self._keep(name, environment, file)
        return self.describe(name)

    async def thumbnail(self, name: str) -> bytes:
        """A small PNG of the map. Raises what `get` raises."""
        if self._current(self.check(name, 404)) is None:
            await self.get(name)
        return self._known[name].thumbnail

    def describe(self, name: str) -> dict[str, Any]:
        """As `GET /environments` lists it; hash and size once it has been read."""
        known = self._known.get(name)
        return {
            "name": name,
            "source": "file" if name in self._files() else "generated",
            "sha256": known and known.sha256,
            "width": known and known.shape[1],
            "height": known and known.shape[0],
            "thumbnail": f"/environments/{name}/thumbnail",
        }

    def _files(self) -> dict[str, Path]:
        """The folder's maps, looked up anew: files may come and go."""
        if self.folder is None or not self.folder.is_dir():
            return {}
        return {
            path.stem: path
            for path in sorted(self.folder.iterdir())
            if path.suffix.lower() in SUFFIXES and _NAME.fullmatch(path.stem)
        }

    def _current(self, name: str) -> _Known | None:
        """What is known of a map, if its file is still the one that was read."""
        known = self._known.get(name)
        if known is None:
            return None
        file = _File.of(known.file.path or self._files().get(name))
        return known if known.file == file else None

    def _write(self, name: str, data: bytes) -> _File:
        assert self.folder is not None, "uploads need a folder"
        target = self.folder / f"{name}{'.hdr' if data.startswith(MAGIC) else '.exr'}"
        with replacing(target) as temporary:
            temporary.write_bytes(data)
        for suffix in SUFFIXES:
            if (other := target.with_suffix(suffix)) != target:
                other.unlink(missing_ok=True)
        return _File.of(target)

    async def _load(self, name: str) -> Prepared:
        try:
            async with self._preparing:
                file = _File.of(self._files().get(name))
                if file.path is None:
                    environment = await asyncio.to_thread(sky, name, height=512)
                else:
                    environment = await asyncio.to_thread(
                        read_environment, file.path, "", self._limits
                    )
                return await self._keep(name, environment, file)
        except DeepshadeError as error:
            log.error("environment %s can't be used: %s", name, error)
            raise
        finally:
            del self._loading[name]

    async def _keep(self, name: str, environment: Environment, file: _File) -> Prepared:
        digest = environment.sha256
        if digest not in self._prepared:
            prepared = await asyncio.to_thread(Prepared.of, environment)
            self._prepared[digest] = prepared
            log.info("environment %s (%s) is prepared", name, digest[:12])
        self._prepared.move_to_end(digest)
        picture = await asyncio.to_thread(_thumbnail, environment)
        self._known[name] = _Known(file, digest, environment.shape, picture)
        # another's request may have moved it behind the newest, which is returned all the same
        prepared = self._prepared[digest]
        while len(self._prepared) > 1 and self.held > self._memory:
            self._prepared.popitem(last=False)
        return prepared


def _thumbnail(environment: Environment) -> bytes:
    """A PNG of at most 2 `_THUMBNAIL` x `_THUMBNAIL` pixels, exposed by the median."""
    step = max(1, environment.shape[0] // _THUMBNAIL)
    rows, columns = (step * (side // step) for side in environment.shape)
    blocks = environment.radiance[:, :rows, :columns]
    small = blocks.reshape(3, rows // step, step, columns // step, step).mean((2, 4))
    middle = float(np.median(small.mean(0)))
    return pictures.png(pictures.srgb(small * (_GREY / middle if middle > 0 else 1)))
