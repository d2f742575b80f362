"""`deepshade samples`: the shipped G-buffers, as files to try everything with."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

import typer

from deepshade.errors import ConfigError
from deepshade.files import replacing, shipped


def samples(
    out: Annotated[Path, typer.Argument(help="Folder to copy them to.")] = Path("samples"),
) -> None:
    """Copy the sample G-buffers into a folder: EXRs with references of every effect.

    Example:

      deepshade samples && deepshade-client shade ao samples/room.exr -o room-ao.exr
    """
    found = sorted(shipped("samples").glob("*.exr"))
    if not found:
        raise ConfigError("samples", detail=f"there are no samples in {shipped('samples')}")
    out.mkdir(parents=True, exist_ok=True)
    for file in found:
        target = out / file.name
        if not (target.exists() and target.samefile(file)):
            with replacing(target) as temporary:
                shutil.copyfile(file, temporary)
        typer.echo(target)
