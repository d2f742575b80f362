"""Procedural scenes: made from seeds, closed, varied."""

from __future__ import annotations

import hashlib
from functools import cache
from typing import Any

import numpy as np
import pytest

from deepshade_workers.scenes.procedural import FAMILIES, generate, primitives
from deepshade_workers.scenes.procedural.assembly import MEAN_FREE_PATHS
from deepshade_workers.scenes.procedural.interiors import curtain, random_cushion, vase
from deepshade_workers.scenes.procedural.nature import leaf

RNG = np.random.default_rng
SOLIDS: dict[str, tuple[Any, float | None]] = {
    "box": (primitives.box, 1.0),
    "sphere": (lambda: primitives.sphere(4), np.pi / 6),
    "cylinder": (lambda: primitives.cylinder(64), np.pi / 4),
    "cone": (lambda: primitives.cone(64), np.pi / 12),
    "torus": (lambda: primitives.torus(0.2, 64, 32), 2 * np.pi**2 * 0.4 * 0.1**2),
    "rock": (lambda: primitives.rock(RNG(1)), None),
    "blob": (lambda: primitives.blob(RNG(1), 0.4), None),
    "tube": (lambda: primitives.tube(np.array([[0, 0, 0], [0, 1.0, 0]]), 0.1, 64), np.pi * 0.01),
    "leaf": (lambda: leaf(RNG(1)), None),
    "curtain": (lambda: curtain(RNG(1), 1, 1), None),
    "vase": (lambda: vase(RNG(1)), None),
    "cushion": (random_cushion, None),
}


@cache
def seven(family: str) -> Any:
    """The scene of that family and of seed 7, which several tests look at."""
    return generate(family, 7)


# Digests of vertices, faces, normals and all of the materials but their scattering, to 1e-6, as
# they were before materials scattered.
BEFORE = {
    "level": "acb9c43a05ccb5c3",
    "rubble": "74343cb6673cb650",
    "foliage": "74f155cb8ff38115",
    "cave": "23fef00434e0d6be",
}


@pytest.mark.parametrize("family", BEFORE)
def test_scattering_changes_nothing_else_of_a_seed(family: str) -> None:
    mesh = seven(family)
    digest = hashlib.sha256()
    for values in (mesh.vertices, mesh.faces, mesh.normals, mesh.materials[:, :7]):
        digest.update((np.round(values, 6) + 0.0).tobytes())
    assert digest.hexdigest()[:16] == BEFORE[family]


def test_some_materials_scatter() -> None:
    colours = np.concatenate([np.unique(seven(f).materials, axis=0) for f in FAMILIES])
    scatter = colours[:, 7:]
    share = (scatter > 0).all(1).mean()
    assert 0.3 < share < 0.5
    assert ((scatter == 0).all(1) | (scatter > 0).all(1)).all()
    low, high = MEAN_FREE_PATHS
    assert 0.2 * low <= scatter[scatter > 0].min() <= scatter.max() <= high


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_keep_their_objects(family: str) -> None:
    mesh = seven(family)
    stops = [item.stop for item in mesh.objects]
    assert [item.start for item in mesh.objects] == [0, *stops[:-1]]
    assert stops[-1] == len(mesh.faces)
    assert len({item.name for item in mesh.objects}) == len(mesh.objects) >= 2
    # No face of one object has a vertex of another.
    number = np.repeat(np.arange(len(stops)), [o.stop - o.start for o in mesh.objects])
    owner = np.full(len(mesh.vertices), -1)
    owner[mesh.faces] = number[:, None]
    assert (owner[mesh.faces] == number[:, None]).all()


def test_there_are_at_least_a_dozen_families() -> None:
    assert len(FAMILIES) >= 12


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_face_outward(name: str) -> None:
    make, expected = SOLIDS[name]
    mesh = make()
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = float(np.einsum("fk,fk->", a, np.cross(b, c)) / 6)
    assert volume > 0
    if expected is not None:
        assert volume == pytest.approx(expected, rel=0.02)
    # The area vectors of a closed surface add up to nothing.
    assert np.abs(np.cross(b - a, c - a).sum(0)).max() < 1e-9
    assert np.allclose(np.linalg.norm(mesh.normals, axis=2), 1)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_seed_makes_the_same_scene_and_another_seed_another(family: str) -> None:
    first, again, other = seven(family), generate(family, 7), generate(family, 8)
    for name in ("vertices", "faces", "normals", "materials"):
        assert (getattr(first, name) == getattr(again, name)).all()
    assert first.vertices.shape != other.vertices.shape or (first.vertices != other.vertices).any()
    assert np.isfinite(first.vertices).all()
    assert len(first.faces) > 500
    assert first.materials[:, :6].min() >= 0
    assert first.materials[:, :6].max() <= 1
