"""Rooms and groves composed of mesh files: `compose:<parts>:<seed>`.

`<parts>` are mesh files and folders of them with + between: a pack of furniture becomes furnished
rooms, one of plants a grove. Each placed mesh is an object.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from deepshade.errors import SceneError
from deepshade_workers.scenes.mesh import Floats, Mesh, merge
from deepshade_workers.scenes.procedural.primitives import Rng, box, place, turn_y

COUNTS = (8, 32)
# Beyond so many triangles no more meshes are placed: a scene takes about a second to make.
MAX_FACES = 250_000
# Sizes come nearer to each other: the largest side becomes side^SIZING, by the typical one's.
SIZING = 0.6
WALL_SHARE = 0.6


@functools.lru_cache(maxsize=32)
def files_of(parts: str, suffixes: frozenset[str]) -> tuple[Path, ...]:
    """The mesh files that `parts` names, in order.

    Raises:
        SceneError: a name is neither a mesh file nor a folder that holds some.
    """
    found: list[Path] = []
    for name in parts.split("+"):
        path = Path(name)
        inside = sorted(path.iterdir()) if path.is_dir() else [path] if path.is_file() else []
        meshes = [p for p in inside if p.suffix.lower() in suffixes]
        if not meshes:
            raise SceneError(
                f"there are no mesh files at {name!r}", fix="write compose:FOLDER+FILE:SEED"
            )
        found += meshes
    return tuple(found)


def compose(parts: str, files: tuple[Path, ...], load: Callable[[Path], Mesh], seed: int) -> Mesh:
    """Place some of the `files` about a floor, often between walls: the same for the same seed.

    Meshes stand on the floor, y up, turned about the vertical, few of them into each other.
    """
    key = int.from_bytes(hashlib.sha256(parts.encode()).digest()[:4], "little")
    rng = np.random.default_rng([key, seed])
    count = int(rng.integers(*COUNTS))
    kinds = rng.choice(len(files), min(len(files), int(rng.integers(4, 13))), replace=False)
    chosen = [kinds[k] for k in rng.integers(len(kinds), size=count)]
    solids = {kind: _standing(load(files[kind])) for kind in kinds.tolist()}
    half = float(np.sqrt(count)) * rng.uniform(0.55, 0.9)  # of the floor's side
    placed: list[Mesh] = []
    names: list[str] = []
    frames: list[Floats] = []
    taken = np.zeros((0, 3))
    for number, kind in enumerate(chosen):
        size = rng.uniform(0.8, 1.25)
        solid = solids[kind]
        if number and sum(len(other.faces) for other in placed) + len(solid.faces) > MAX_FACES:
            continue
        reach = size * float(np.linalg.norm(solid.vertices[:, [0, 2]], axis=1).max())
        spot = _free_spot(rng, half, reach, taken)
        taken = np.concatenate([taken, [[*spot, reach]]])
        angle = float(rng.choice([0, 0.5, 1, 1.5, rng.uniform(0, 2)])) * np.pi
        frames.append(place((spot[0], 0, spot[1]), size, turn_y(angle)))
        placed.append(solid.transformed(frames[-1]))
        names.append(f"{files[kind].stem} {number}")
    shell = _shell(rng, half + 0.4)
    frames += [np.eye(4)] * len(shell)
    return merge([*placed, *shell.values()], [*names, *shell], frames)


def _standing(mesh: Mesh) -> Mesh:
    """The mesh above the origin, its longest side about 1, as no part of other objects."""
    used = mesh.vertices[np.unique(mesh.faces)]
    low, high = used.min(0), used.max(0)
    side = float((high - low).max()) or 1.0
    # A book stays smaller than a bed: packs are modelled at about 2 units a piece.
    scale = (side / 2) ** (1 - SIZING) / side if 0.02 < side < 50 else 1 / side
    middle = (low + high) / 2
    at = -scale * np.array([middle[0], low[1], middle[2]])
    return replace(mesh, objects=()).transformed(place(at, scale))


def _free_spot(rng: Rng, half: float, reach: float, taken: Floats) -> Floats:
    """Of a few places on the floor the one that is farthest from overlapping with others."""
    spots = rng.uniform(-half, half, (12, 2))
    if not len(taken):
        return np.asarray(spots[0])
    apart = np.linalg.norm(spots[:, None] - taken[None, :, :2], axis=2) - taken[:, 2] - reach
    clear = apart.min(1)
    enough = np.flatnonzero(clear > -0.1 * reach)
    return np.asarray(spots[int(enough[0]) if len(enough) else int(clear.argmax())])


def _shell(rng: Rng, half: float) -> dict[str, Mesh]:
    """A floor, and at times walls and a ceiling."""

    def block(low: tuple[float, ...], high: tuple[float, ...]) -> Mesh:
        a, b = np.array(low), np.array(high)
        return box().transformed(place((a + b) / 2, b - a))

    walls = rng.random() < WALL_SHARE
    edge = half if walls else 3 * half
    found = {"floor": block((-edge, -0.3, -edge), (edge, 0, edge))}
    if not walls:
        return found
    high = float(rng.uniform(1.4, 2.6))
    sides = {
        "wall 1": ((-half - 0.2, 0, -half), (-half, high, half)),
        "wall 2": ((half, 0, -half), (half + 0.2, high, half)),
        "wall 3": ((-half, 0, -half - 0.2), (half, high, -half)),
        "wall 4": ((-half, 0, half), (half, high, half + 0.2)),
    }
    for name in rng.permutation(list(sides))[: int(rng.integers(1, 5))].tolist():
        found[name] = block(*sides[name])
    if rng.random() < 0.4:
        found["ceiling"] = block((-half, high, -half), (half, high + 0.2, half))
    return found
