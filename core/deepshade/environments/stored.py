"""Environment maps that lie beside what was rendered with them, by the hash of their values."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from deepshade import exr
from deepshade.environments.environment import Environment, read_environment
from deepshade.environments.surroundings import Surroundings
from deepshade.errors import DataError
from deepshade.files import replacing

FOLDER = "environments"


def stored_path(folder: Path, sha256: str) -> Path:
    """Where the map of that hash lies in a data set's `folder`."""
    return folder / FOLDER / f"{sha256}.exr"


def store(folder: Path, environment: Environment) -> Path:
    """Write the map into a data set's `folder`, in float32; one that is there stays."""
    path = stored_path(folder, environment.sha256)
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            exr.write(temporary, dict(zip("RGB", environment.radiance, strict=True)))
    return path


def surroundings_of(folder: Path, record: Mapping[str, Any]) -> Surroundings | None:
    """What a sample of the data set in `folder` was rendered under, by its record; None: nothing.

    Maps that were read stay in memory for a while. Raises as `read_stored`.
    """
    if "environment_sha256" not in record:
        return None
    digest, name = record["environment_sha256"], record["environment"]
    return Surroundings(_read_once(folder, digest, name), float(record["rotate"]))


def read_stored(folder: Path, sha256: str, name: str = "") -> Environment:
    """The map of that hash in a data set's `folder`.

    Raises:
        DataError: it isn't there, or is another.
    """
    path = stored_path(folder, sha256)
    if not path.is_file():
        raise DataError(
            f"{path} is missing", fix="run the same 'deepshade datagen' again: it writes it"
        )
    found = read_environment(path, name)
    if found.sha256 != sha256:
        raise DataError(f"{path} holds another map: its hash is {found.sha256}")
    return found


_read_once = lru_cache(maxsize=32)(read_stored)
