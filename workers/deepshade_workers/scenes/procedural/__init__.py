"""Scenes made from a seed: `procedural:<family>:<seed>`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from deepshade_workers.scenes.mesh import Mesh
from deepshade_workers.scenes.procedural import exteriors, interiors, nature

FAMILIES: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "room": interiors.room,
    "furniture": interiors.furniture,
    "stairs": interiors.stairs,
    "level": interiors.level,
    "colonnade": exteriors.colonnade,
    "town": exteriors.town,
    "fences": exteriors.fences,
    "pipes": exteriors.pipes,
    "machines": exteriors.machines,
    "foliage": nature.foliage,
    "rubble": nature.rubble,
    "terrain": nature.terrain,
    "cave": nature.cave,
    "blobs": nature.blobs,
    "scattered": nature.scattered,
    "figures": nature.figures,
    "drapery": nature.drapery,
    "crockery": nature.crockery,
}


def generate(family: str, seed: int) -> Mesh:
    """The mesh of `family` for `seed`: the same bytes every time."""
    key = int.from_bytes(hashlib.sha256(family.encode()).digest()[:4], "little")
    return FAMILIES[family](np.random.default_rng([key, seed]))
