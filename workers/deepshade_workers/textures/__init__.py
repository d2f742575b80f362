"""Textures: linear reflectance in [0, 1], (size, size, 3), that repeat at their borders.

Each public function of the modules named here is a generator f(rng, size), in `GENERATORS`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from deepshade_workers.textures import cloth, ground, marks, masonry, stone, wood
from deepshade_workers.textures.patterns import Rng
from deepshade_workers.textures.pictures import pictures

__all__ = ["GENERATORS", "SIDE", "Texture", "draw_textures", "pictures"]

Texture = NDArray[np.float64]

SIDE = 256  # texels, a power of 2
# How often a texture is a picture where a folder of them is given.
PICTURE_SHARE = 0.25

GENERATORS: dict[str, Callable[[Rng, int], Texture]] = {
    name: function
    for module in (stone, wood, masonry, cloth, ground, marks)
    for name, function in vars(module).items()
    if not name.startswith("_") and getattr(function, "__module__", "") == module.__name__
}


def draw_textures(rng: Rng, count: int, folder: str | None = None) -> list[Texture]:
    """`count` textures (SIDE, SIDE, 3), some of them pictures from `folder` if there is one."""
    found = pictures(folder, SIDE) if folder else ()
    names = list(GENERATORS)
    drawn = []
    for name in rng.choice(len(names), count, replace=False):
        own, picture = rng.spawn(1)[0], rng.random() < PICTURE_SHARE
        if picture and found:
            drawn.append(found[int(own.integers(len(found)))])
        else:
            drawn.append(np.clip(GENERATORS[names[name]](own, SIDE), 0, 1))
    return drawn
