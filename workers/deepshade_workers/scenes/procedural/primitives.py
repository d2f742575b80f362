"""Closed solids in unit sizes, and the transforms that place them.

Every solid is centred at the origin and fits a box of side 1 unless it says otherwise; y is up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import trimesh

from deepshade_workers.scenes.mesh import Floats, Mesh

Rng = np.random.Generator


def place(
    position: tuple[float, float, float] | Floats = (0, 0, 0),
    size: tuple[float, float, float] | Floats | float = 1.0,
    rotation: Floats | None = None,
) -> Floats:
    """(4, 4) transform: scale by `size`, turn by `rotation` (3, 3), move to `position`."""
    matrix = np.eye(4)
    linear = np.diag(np.broadcast_to(np.asarray(size, np.float64), (3,)))
    matrix[:3, :3] = linear if rotation is None else rotation @ linear
    matrix[:3, 3] = position
    return matrix


def turn_y(angle: float) -> Floats:
    """(3, 3) rotation by `angle` radians about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def random_rotation(rng: Rng) -> Floats:
    """(3, 3) rotation, uniform over all of them (QR of a Gaussian matrix)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return np.asarray(q * np.sign(np.linalg.det(q)))


def along(start: Floats, end: Floats, thickness: float) -> Floats:
    """(4, 4) transform that stretches a y-aligned unit solid from `start` to `end`."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = end - start
    length = float(np.linalg.norm(axis))
    up = axis / max(length, 1e-12)
    helper = np.array([1.0, 0, 0]) if abs(up[0]) < 0.8 else np.array([0, 0, 1.0])
    side = np.cross(up, helper)
    side /= np.linalg.norm(side)
    rotation = np.stack([side, up, np.cross(side, up)], axis=1)
    return place((start + end) / 2, (thickness, length, thickness), rotation)


@functools.cache
def box() -> Mesh:
    """The unit cube."""
    solid = trimesh.creation.box((1, 1, 1))
    return Mesh.build(solid.vertices, solid.faces, crease=0)


@functools.cache
def sphere(detail: int = 3) -> Mesh:
    """A smooth ball of diameter 1."""
    solid = trimesh.creation.icosphere(subdivisions=detail, radius=0.5)
    return Mesh.build(solid.vertices, solid.faces, crease=180)


@functools.cache
def cylinder(sides: int = 24) -> Mesh:
    """An upright cylinder of diameter and height 1; few sides make a prism."""
    return lathe(np.array([[0, -0.5], [0.5, -0.5], [0.5, 0.5], [0, 0.5]]), sides)


@functools.cache
def cone(sides: int = 24) -> Mesh:
    """An upright cone of base diameter and height 1."""
    return lathe(np.array([[0, -0.5], [0.5, -0.5], [0, 0.5]]), sides)


@functools.cache
def torus(thickness: float = 0.15, around: int = 32, across: int = 14) -> Mesh:
    """A ring lying flat, of outer diameter 1."""
    solid = trimesh.creation.torus(0.5 - thickness / 2, thickness / 2, around, across)
    return Mesh.build(solid.vertices[:, [0, 2, 1]], solid.faces[:, ::-1], crease=180)


def lathe(profile: Floats, sides: int = 32, crease: float = 40.0) -> Mesh:
    """Turn a (n, 2) profile of (radius, height), bottom to top on the outside, about y."""
    angles = 2 * np.pi * np.arange(sides) / sides
    radius, height = np.asarray(profile, np.float64).T
    x = radius[:, None] * np.sin(angles)
    z = radius[:, None] * np.cos(angles)
    y = np.broadcast_to(height[:, None], x.shape)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return Mesh.build(vertices, grid_faces(len(profile), sides, wrap=True), crease=crease)


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> np.ndarray:
    """Triangles of a (rows, columns) grid of vertices; `wrap` closes each row into a ring."""
    r = np.arange(rows - 1)[:, None]
    c = np.arange(columns if wrap else columns - 1)[None]
    a = r * columns + c
    b = r * columns + (c + 1) % columns
    quads = np.stack([a, b, b + columns, a + columns], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def sheet(height: Callable[[Floats, Floats], Floats], cells: int, size: float) -> Mesh:
    """A square height field y = height(x, z) over `size` units, facing up."""
    axis = np.linspace(-size / 2, size / 2, cells + 1)
    x, z = np.meshgrid(axis, axis)
    vertices = np.stack([x, height(x, z), z], axis=-1).reshape(-1, 3)
    return Mesh.build(vertices, grid_faces(cells + 1, cells + 1)[:, ::-1], crease=60)


def slab(surface: Floats, thickness: float, crease: float = 60.0) -> Mesh:
    """Close a (rows, columns, 3) surface into a thin solid, `thickness` deep."""
    rows, columns, _ = surface.shape
    across = np.gradient(surface, axis=1)
    down = np.gradient(surface, axis=0)
    normal = np.cross(down, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    front = (surface + normal * thickness / 2).reshape(-1, 3)
    back = (surface - normal * thickness / 2).reshape(-1, 3)
    faces = grid_faces(rows, columns)
    index = np.arange(rows * columns).reshape(rows, columns)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    ahead = np.roll(rim, -1)
    count = rows * columns
    sides = np.concatenate(
        [
            np.stack([rim, ahead, ahead + count], 1),
            np.stack([rim, ahead + count, rim + count], 1),
        ]
    )
    faces = np.concatenate([faces[:, ::-1], faces + count, sides])
    return Mesh.build(np.concatenate([front, back]), faces, crease=crease)


def noise(rng: Rng, octaves: int = 4, frequency: float = 1.0) -> Callable[[Floats], Floats]:
    """Smooth random function of (n, 3) points in about [-1, 1]: sums of random plane waves."""
    waves = 12
    direction = rng.normal(size=(octaves, waves, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    scale = 2.0 ** np.arange(octaves)
    vector = direction * (frequency * scale * 2 * np.pi)[:, None, None]
    phase = rng.uniform(0, 2 * np.pi, (octaves, waves))

    def evaluate(points: Floats) -> Floats:
        value = np.zeros(len(points))
        for level in range(octaves):
            wave = np.sin(points @ vector[level].T + phase[level]).sum(1)
            value += wave * np.sqrt(2 / waves) / scale[level]
        return value / 2

    return evaluate


def over_plane(wave: Callable[[Floats], Floats], x: Floats, z: Floats) -> Floats:
    """`noise` at the points (x, 0, z), in the shape of `x`."""
    return wave(np.stack([x, 0 * x, z], -1).reshape(-1, 3)).reshape(x.shape)


def blob(rng: Rng, roughness: float, *, detail: int = 4, creased: bool = False) -> Mesh:
    """A noise-displaced ball of diameter about 1; `creased` folds the noise into ridges."""
    solid = trimesh.creation.icosphere(subdivisions=detail, radius=0.5)
    offset = noise(rng, octaves=3, frequency=rng.uniform(0.6, 1.4))(np.asarray(solid.vertices))
    if creased:
        offset = np.abs(offset) * 2 - 0.5
    vertices = np.asarray(solid.vertices) * (1 + roughness * offset[:, None])
    return Mesh.build(vertices, solid.faces, crease=25 if creased else 180)


def rock(rng: Rng, corners: int = 14) -> Mesh:
    """The convex hull of random points in a ball of diameter 1."""
    points = rng.normal(size=(corners, 3))
    points *= 0.5 * rng.uniform(0.7, 1, (corners, 1)) / np.linalg.norm(points, axis=1)[:, None]
    hull = trimesh.convex.convex_hull(points)
    return Mesh.build(hull.vertices, hull.faces, crease=0)


def tube(path: Floats, radius: float, sides: int = 12) -> Mesh:
    """A round pipe along the (n, 3) points of `path`, closed at both ends."""
    path = np.asarray(path, np.float64)
    tangent = np.gradient(path, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    side = np.cross(tangent[0], [0.31, 0.77, 0.55])
    rings = []
    for point, direction in zip(path, tangent, strict=True):
        side = side - direction * (side @ direction)  # carried along, so that it does not twist
        side /= np.linalg.norm(side)
        other = np.cross(direction, side)
        angle = 2 * np.pi * np.arange(sides)[:, None] / sides
        rings.append(point + radius * (np.cos(angle) * side + np.sin(angle) * other))
    ends = [np.repeat(path[:1], sides, 0), *rings, np.repeat(path[-1:], sides, 0)]
    faces = grid_faces(len(ends), sides, wrap=True)
    return Mesh.build(np.concatenate(ends), faces, crease=50)


def random_solid(rng: Rng) -> Mesh:
    """One of the solids above, at random."""
    kinds: list[Callable[[], Mesh]] = [
        box,
        sphere,
        lambda: cylinder(int(rng.choice([5, 6, 8, 24]))),
        lambda: cone(int(rng.choice([4, 6, 24]))),
        lambda: torus(float(rng.choice([0.1, 0.2, 0.3]))),
        lambda: rock(rng),
        lambda: blob(rng, 0.5, detail=3),
    ]
    return kinds[int(rng.integers(len(kinds)))]()
