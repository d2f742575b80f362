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
MAX_PREPARED = 4  # in memory, about 100 MB each; of others the one used longest ago goes
MAX_MAPS = 1024  # that uploads may add up to

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_THUMBNAIL = 64  # rows
_GREY = 0.35  # what a map's mean is shown as


@dataclass(slots=True)
class _Known:
    """What is known of a map since it was last read."""

    sha256: str
    shape: tuple[int, int]
    thumbnail: bytes


class Environments:
    """Maps by name: the files of a folder, and a generated sky.

    Each is read and prepared when it is first asked for, and what is prepared is kept by its
    hash. Only for use on the event loop; what blocks is done in threads.
    """

    def __init__(self, folder: Path | None, limits: Limits) -> None:
        self.folder = folder
        self._limits = limits
        self._known: dict[str, _Known] = {}
        self._prepared: OrderedDict[str, Prepared] = OrderedDict()  # by sha256
        self._loading: dict[str, asyncio.Task[Prepared]] = {}

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
        known = self._known.get(name)
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
        environment = await asyncio.to_thread(read_environment, data, name, self._limits)
        await asyncio.to_thread(self._write, name, data)
        self._known.pop(name, None)
        await self._keep(name, environment)
        return self.describe(name)

    async def thumbnail(self, name: str) -> bytes:
        """A small PNG of the map. Raises what `get` raises."""
        if self.check(name, 404) not in self._known:
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

    def _write(self, name: str, data: bytes) -> None:
        assert self.folder is not None, "uploads need a folder"
        target = self.folder / f"{name}{'.hdr' if data.startswith(MAGIC) else '.exr'}"
        with replacing(target) as temporary:
            temporary.write_bytes(data)
        for suffix in SUFFIXES:
            if (other := target.with_suffix(suffix)) != target:
                other.unlink(missing_ok=True)

    async def _load(self, name: str) -> Prepared:
        try:
            path = self._files().get(name)
            if path is None:
                environment = await asyncio.to_thread(sky, name, height=512)
            else:
                environment = await asyncio.to_thread(read_environment, path, "", self._limits)
            return await self._keep(name, environment)
        except DeepshadeError as error:
            log.error("environment %s can't be used: %s", name, error)
            raise
        finally:
            del self._loading[name]

    async def _keep(self, name: str, environment: Environment) -> Prepared:
        digest = environment.sha256
        if digest not in self._prepared:
            prepared = await asyncio.to_thread(Prepared.of, environment)
            self._prepared[digest] = prepared
            log.info("environment %s (%s) is prepared", name, digest[:12])
        self._prepared.move_to_end(digest)
        picture = await asyncio.to_thread(_thumbnail, environment)
        self._known[name] = _Known(digest, environment.shape, picture)
        while len(self._prepared) > MAX_PREPARED:
            self._prepared.popitem(last=False)
        return self._prepared[digest]


def _thumbnail(environment: Environment) -> bytes:
    """A PNG of at most 2 `_THUMBNAIL` x `_THUMBNAIL` pixels, exposed by the median."""
    step = max(1, environment.shape[0] // _THUMBNAIL)
    rows, columns = (step * (side // step) for side in environment.shape)
    blocks = environment.radiance[:, :rows, :columns]
    small = blocks.reshape(3, rows // step, step, columns // step, step).mean((2, 4))
    middle = float(np.median(small.mean(0)))
    return pictures.png(pictures.srgb(small * (_GREY / middle if middle > 0 else 1)))
