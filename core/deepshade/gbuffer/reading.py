"""The files of a view: their bytes, and the quantities that are read from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.errors import ImageError
from deepshade.exr import Header, Limits
from deepshade.gbuffer import channels
from deepshade.gbuffer.profiles import QUANTITIES

Body = bytes | exr.Planes
Source = Path | str | bytes | tuple[str, Body]
# quantities that were read to choose between them, and whether they hold NaN or infinities
Read = dict[channels.Choice, tuple[NDArray[np.float32], bool]]


def source_name(field: str, filename: str) -> str:
    """What a form's file is called: its field if that names a quantity, else its file name."""
    return f"{field}.exr" if field in QUANTITIES else filename


def fetch(sources: Source | Sequence[Source], limits: Limits) -> tuple[list[str], list[Body]]:
    """(the files' names without suffix, their bytes). Raises ImageError, LimitError."""
    if isinstance(sources, str | bytes | Path) or (
        isinstance(sources, tuple) and [type(item) for item in sources] == [str, bytes]
    ):
        sources = [cast(Source, sources)]
    stems: list[str] = []
    bodies: list[Body] = []
    total = 0
    for source in cast(Sequence[Source], sources):
        named = source if isinstance(source, tuple) else (source, exr.fetch(source, limits))
        stems.append("" if isinstance(named[0], bytes) else Path(named[0]).stem)
        bodies.append(named[1])
        total += len(bodies[-1])
        limits.check("body_bytes", total)
    if not bodies:
        raise ImageError("no image was given", fix="name at least one EXR file")
    return stems, bodies


def read_choices(
    bodies: Sequence[Body],
    headers: Sequence[Header],
    choices: Mapping[str, channels.Choice],
    limits: Limits,
    read: Read,
) -> tuple[dict[str, NDArray[np.float32]], set[str]]:
    """(the chosen quantities, which of them hold NaN or infinities).

    What was `read` before is taken from there: arrays are worked on in place.
    """
    arrays: dict[str, NDArray[np.float32]] = {}
    suspects: set[str] = set()
    for index, (body, header) in enumerate(zip(bodies, headers, strict=True)):
        mine = {name: choice for name, choice in choices.items() if choice.file == index}
        for name in [name for name in mine if mine[name] in read]:
            arrays[name], suspect = read.pop(mine.pop(name))
            suspects |= {name} if suspect else set()
        if not mine:
            continue
        wanted = [channel for choice in mine.values() for channel in choice.channels]
        image = exr.read(body, wanted, limits, header=header)
        users = Counter(channel for choice in mine.values() for channel in set(choice.channels))
        for name, choice in mine.items():
            array = image.stack(choice.channels)
            # attributes that share a channel don't share its memory: each has signs of its own
            if any(users[channel] > 1 for channel in choice.channels):
                array = array.copy()
            for plane, sign in zip(array, choice.signs, strict=False):
                if sign < 0:
                    np.negative(plane, out=plane)
            arrays[name] = array
            if not image.nonfinite.isdisjoint(choice.channels):
                suspects.add(name)
    return arrays, suspects
