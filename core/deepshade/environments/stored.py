"""Environment maps that lie beside what was rendered with them, by the hash of their values."""

from __future__ import annotations

from pathlib import Path

from deepshade import exr
from deepshade.environments.environment import Environment, read_environment
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
