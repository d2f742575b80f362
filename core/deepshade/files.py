"""Files that are the old or the new version, never half of one; their hashes; what ships."""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name beside `path` that takes its place, synced, if the block succeeds."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def scratch(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, for a file that is gone after the block unless it was moved.

    One that a kill left behind is written over.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def shipped(kind: str) -> Path:
    """The folder of what comes with the program, "models" or "samples": in the wheel or a clone."""
    packed = Path(__file__).parent / "shipped" / kind
    return packed if packed.is_dir() else Path(__file__).resolve().parents[2] / kind


def sync_folder(folder: Path) -> None:
    """The new name too survives a power cut. Windows can't open folders, nor needs to."""
    if os.name == "nt":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # some network file systems refuse it
            os.fsync(descriptor)
    finally:
        os.close(descriptor)
