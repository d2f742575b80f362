"""Scenes made from a seed: `procedural:<family>:<seed>`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from deepshade_workers.scenes.mesh import Mesh
from deepshade_workers.scenes.procedural import exteriors, interiors, nature

_IN = (interiors.room, interiors.furniture, interiors.stairs, interiors.level)
_OUT = (exteriors.colonnade, exteriors.town, exteriors.fences, exteriors.pipes, exteriors.machines)
_GROWN = (nature.foliage, nature.rubble, nature.terrain, nature.cave, nature.blobs)
_LOOSE = (nature.scattered, nature.figures, nature.drapery, nature.crockery)

# Their order is that in which a data set takes them in turn.
FAMILIES: dict[str, Callable[[np.random.Generator], Mesh]] = {
    family.__name__: family for family in (*_IN, *_OUT, *_GROWN, *_LOOSE)
}


def generate(family: str, seed: int) -> Mesh:
    """The mesh of `family` for `seed`: the same bytes every time."""
    key = int.from_bytes(hashlib.sha256(family.encode()).digest()[:4], "little")
    return FAMILIES[family](np.random.default_rng([key, seed]))
