"""Finds the libLLVM that Mitsuba's `llvm_*` variants load at run time."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

OLDEST = 17  # 14 and 15 are refused by Dr.Jit, 16 crashes in it
_PREFERRED = (19, 20, 18, 17)  # newer ones after these

_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
FIX = "sudo apt-get install libllvm19 (or set DRJIT_LIBLLVM_PATH to a libLLVM 17 or newer)"


def find_libllvm(
    environ: Mapping[str, str] = os.environ, folders: tuple[str, ...] = _FOLDERS
) -> Path | None:
    """The libLLVM to use, or None. `DRJIT_LIBLLVM_PATH` wins if it names a file.

    Set that variable to the result before the first `import mitsuba`.
    """
    chosen = environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return Path(chosen) if Path(chosen).is_file() else None

    def order(path: Path) -> tuple[int, int, str]:
        version = libllvm_version(path) or 0
        known = _PREFERRED.index(version) if version in _PREFERRED else len(_PREFERRED)
        return known, version, str(path)

    found = [
        library
        for pattern in folders
        for folder in Path("/").glob(pattern.lstrip("/"))
        for library in (*folder.glob("libLLVM*.so*"), *folder.glob("libLLVM*.dylib"))
        if library.is_file() and (libllvm_version(library) or 0) >= OLDEST
    ]
    return min(found, key=order, default=None)


def libllvm_version(path: Path) -> int | None:
    """The major version in a library's (resolved) file name, or None if it shows none."""
    for name in (path.name, path.resolve().name):
        match = re.search(r"LLVM(?:-(\d+)|\.so\.(\d+)|\.(\d+)\.dylib)", name)
        if match:
            return int(next(group for group in match.groups() if group))
    match = re.search(r"llvm(?:-|@)(\d+)", str(path))
    return int(match.group(1)) if match else None
