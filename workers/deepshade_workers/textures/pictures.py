"""Pictures from a folder, as textures."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import SceneError

SUFFIXES = {".png", ".jpg", ".jpeg"}


@functools.cache
def pictures(folder: str, size: int) -> tuple[NDArray[np.float64], ...]:
    """The opaque pictures of `folder` in order of their names: linear, (size, size, 3).

    sRGB is decoded (IEC 61966-2-1). A square from the middle is scaled down; a picture that
    repeats goes on repeating only if it is square. Those with transparent parts, which are
    cut-outs, are left out.

    Raises:
        SceneError: there is no such folder, or no opaque picture in it.
    """
    from PIL import Image

    found = []
    names = sorted(p for p in Path(folder).glob("*") if p.suffix.lower() in SUFFIXES)
    for path in names:
        with Image.open(path) as opened:
            if "A" in opened.getbands() or "transparency" in opened.info:
                continue
            side = min(opened.size)
            left, top = ((length - side) // 2 for length in opened.size)
            square = opened.convert("RGB").crop((left, top, left + side, top + side))
        shown = np.asarray(square.resize((size, size), Image.Resampling.BOX), np.float64) / 255
        found.append(np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4))
    if not found:
        raise SceneError(
            f"the folder of textures {folder} holds no opaque picture",
            fix="give a folder with PNG or JPEG files, or leave --textures out",
        )
    return tuple(found)
