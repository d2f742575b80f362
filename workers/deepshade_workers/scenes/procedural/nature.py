"""Grown and worn things: plants, rocks, terrain, caves, figures, cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from deepshade_workers.scenes.mesh import Floats, Mesh
from deepshade_workers.scenes.procedural.assembly import Assembly
from deepshade_workers.scenes.procedural.interiors import clutter, curtain, vase
from deepshade_workers.scenes.procedural.primitives import (
    Rng,
    blob,
    cone,
    noise,
    place,
    random_rotation,
    random_solid,
    rock,
    sheet,
    slab,
    tube,
    turn_y,
)


def leaf(rng: Rng) -> Mesh:
    """A thin curved leaf of length 1 that grows along +z from the origin."""
    t = np.linspace(0, 1, 7)
    s = np.linspace(-1, 1, 5)
    width = rng.uniform(0.08, 0.3) * np.sin(np.pi * np.clip(t, 0.03, 0.97)) ** rng.uniform(0.5, 1.2)
    bend, fold = rng.uniform(-0.5, 0.3), rng.uniform(0, 0.5)
    tt, ss = np.meshgrid(t, s, indexing="ij")
    x = ss * width[:, None]
    y = bend * tt**2 + fold * np.abs(x)
    return slab(np.stack([x, y, tt], -1), 0.008)


def _aim(rng: Rng, direction: Floats) -> Floats:
    """(3, 3) rotation that turns +z to `direction`, with a random roll."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(rng.normal(size=3), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _bush(a: Assembly, at: Floats, size: float, leaves: int) -> None:
    """Branches with leaves around `at`."""
    rng = a.rng
    shapes = [leaf(rng) for _ in range(3)]
    branches = int(rng.integers(3, 9))
    for _ in range(branches):
        up = np.array([*rng.normal(0, 0.6, 2), 0])[[0, 2, 1]] + np.array([0, 1.0, 0])
        t = np.linspace(0, 1, 8)[:, None]
        bend = rng.normal(0, 0.3, 3)
        path = at + size * (t * up + t**2 * bend)
        a.add(tube(path, size * rng.uniform(0.008, 0.025), 6))
        for _ in range(leaves // branches):
            k = rng.uniform(0.15, 1)
            foot = at + size * (k * up + k**2 * bend)
            direction = rng.normal(size=3) + np.array([0, 0.4, 0])
            length = size * rng.uniform(0.1, 0.35)
            shape = shapes[int(rng.integers(3))]
            a.add(shape, place(foot, length, _aim(rng, direction)))


def foliage(rng: Rng) -> Mesh:
    """Bushes, grass and pots: thin leaves over uneven ground."""
    a = Assembly(rng)
    wave = noise(rng, 3, 0.08)

    def height(x: Floats, z: Floats) -> Floats:
        return 0.3 * wave(np.stack([x, 0 * x, z], -1).reshape(-1, 3)).reshape(x.shape)

    a.add(sheet(height, 48, 14))
    for _ in range(int(rng.integers(3, 9))):
        a.paint()
        x, z = rng.uniform(-1.8, 1.8, 2)
        ground = float(height(np.array([x]), np.array([z]))[0])
        _bush(a, np.array([x, ground, z]), rng.uniform(0.6, 2.2), int(rng.integers(40, 130)))
    a.paint()
    blades = [leaf(rng) for _ in range(4)]
    for x, z in rng.uniform(-3, 3, (int(rng.integers(0, 350)), 2)):
        ground = float(height(np.array([x]), np.array([z]))[0])
        aim = _aim(rng, np.array([rng.normal(0, 0.4), 1, rng.normal(0, 0.4)]))
        high = rng.uniform(0.15, 0.6)
        a.add(blades[int(rng.integers(4))], place((x, ground, z), (high * 0.4, high, high), aim))
    for _ in range(int(rng.integers(0, 8))):
        a.paint()
        x, z = rng.uniform(-2.5, 2.5, 2)
        a.add(rock(rng), place((x, 0.1, z), rng.uniform(0.2, 0.8, 3), random_rotation(rng)))
    if rng.random() < 0.4:
        a.span((-5, -1, -3), (5, 3, -2.7))
    return a.finish()


def rubble(rng: Rng) -> Mesh:
    """A pile of rocks, planks and broken blocks."""
    a = Assembly(rng)
    a.floor(16)
    count = int(rng.integers(60, 200))
    spread = rng.uniform(0.8, 2)
    for _ in range(count):
        if rng.random() < 0.15:
            a.paint()
        x, z = rng.normal(0, spread, 2)
        pile = 1.2 * np.exp(-(x * x + z * z) / spread**2)
        at = np.array([x, rng.uniform(0, 1) * pile + 0.1, z])
        size = rng.uniform(0.1, 0.8) * rng.uniform(0.4, 1, 3)
        shape = rock(rng) if rng.random() < 0.6 else random_solid(rng)
        if rng.random() < 0.15:
            size = np.array([0.08, rng.uniform(0.8, 2), 0.2])
            a.box(at, size, random_rotation(rng))
        else:
            a.add(shape, place(at, size, random_rotation(rng)))
    if rng.random() < 0.4:
        a.span((-4, 0, -2.4), (4, 3, -2.2))
    return a.finish()


def terrain(rng: Rng) -> Mesh:
    """Hills and ravines with boulders and cone trees."""
    a = Assembly(rng)
    wave = noise(rng, 6, rng.uniform(0.05, 0.12))
    relief, ridged = rng.uniform(1, 3), rng.random() < 0.5

    def height(x: Floats, z: Floats) -> Floats:
        value = wave(np.stack([x, 0 * x, z], -1).reshape(-1, 3)).reshape(x.shape)
        return np.asarray(relief * (1 - 2 * np.abs(value) if ridged else value))

    a.add(sheet(height, 160, 14))
    for _ in range(int(rng.integers(10, 60))):
        a.paint()
        x, z = rng.uniform(-5, 5, 2)
        ground = float(height(np.array([x]), np.array([z]))[0])
        if rng.random() < 0.6:
            size = rng.uniform(0.15, 0.9, 3)
            a.add(rock(rng), place((x, ground, z), size, random_rotation(rng)))
        else:
            high = rng.uniform(0.6, 1.8)
            a.bar(np.array([x, ground, z]), np.array([x, ground + 0.5 * high, z]), 0.1 * high)
            for k in range(3):
                at = (x, ground + high * (0.45 + 0.25 * k), z)
                wide = high * (0.55 - 0.13 * k)
                a.add(cone(12), place(at, (wide, high * 0.4, wide)))
    return a.finish()


def cave(rng: Rng) -> Mesh:
    """The inside of a rough hollow, with boulders and stalagmites."""
    a = Assembly(rng)
    hollow = blob(rng, rng.uniform(0.3, 0.7), detail=5, creased=rng.random() < 0.4)
    inside = replace(hollow.flipped(), normals=-hollow.normals[:, ::-1])
    a.add(inside, place(size=(9, 6, 9)))
    for _ in range(int(rng.integers(20, 60))):
        a.paint()
        direction = rng.normal(size=3)
        direction[1] = -abs(direction[1]) if rng.random() < 0.7 else direction[1]
        direction /= np.linalg.norm(direction)
        at = direction * np.array([4.0, 2.6, 4.0]) * rng.uniform(0.75, 1)
        size = rng.uniform(0.3, 1.4, 3)
        if rng.random() < 0.4:
            size[1] *= 2
            flip = np.eye(3) if at[1] < 0 else np.diag([1.0, -1, -1])
            a.add(cone(10), place(at, size * np.array([0.4, 1, 0.4]), flip))
        else:
            a.add(rock(rng), place(at, size, random_rotation(rng)))
    return a.finish()


def blobs(rng: Rng) -> Mesh:
    """Smooth and creased lumps, touching each other and the ground."""
    a = Assembly(rng)
    if rng.random() < 0.8:
        a.floor(14)
    for _ in range(int(rng.integers(2, 12))):
        a.paint()
        size = rng.uniform(0.6, 2.4)
        at = np.array([*rng.normal(0, 1.1, 2), 0])[[0, 2, 1]] + np.array([0, 0.4 * size, 0])
        lump = blob(rng, rng.uniform(0.2, 1.2), detail=5, creased=rng.random() < 0.5)
        a.add(lump, place(at, size * rng.uniform(0.6, 1, 3), random_rotation(rng)))
    return a.finish()


def scattered(rng: Rng) -> Mesh:
    """Random solids in the air and on the floor, sometimes very many."""
    a = Assembly(rng)
    if rng.random() < 0.75:
        a.floor(14)
    count = int(2 ** rng.uniform(4, 8))
    reach = rng.uniform(1.2, 2.8)
    for _ in range(count):
        if rng.random() < 0.3:
            a.paint()
        at = rng.uniform(-reach, reach, 3) + np.array([0, reach, 0])
        if rng.random() < 0.5:
            at[1] = 0.2
        size = 2.5 * count ** (-1 / 3) * rng.uniform(0.2, 1.2) * rng.uniform(0.5, 1, 3)
        a.add(random_solid(rng), place(at, size, random_rotation(rng)))
    return a.finish()


def figures(rng: Rng) -> Mesh:
    """Animal-like figures of rounded limbs, alone or in a group, with or without ground."""
    a = Assembly(rng)
    if rng.random() < 0.6:
        a.floor(14)
    for _ in range(int(rng.integers(1, 5))):
        a.paint()
        x, z = rng.normal(0, 1.2, 2)
        _figure(a, np.array([x, 0, z]), turn_y(rng.uniform(0, 6.3)), rng.uniform(0.8, 2))
    return a.finish()


def _figure(a: Assembly, at: Floats, turn: Floats, size: float) -> None:
    """A body, a head with ears and snout, legs and a tail."""
    rng = a.rng

    def lump(center: Floats, extent: Floats, tilt: Floats | None = None) -> None:
        rotation = turn if tilt is None else turn @ tilt
        shape = blob(rng, rng.uniform(0.05, 0.35), detail=4)
        a.add(shape, place(at + turn @ (center * size), extent * size, rotation))

    leg, long, thick = rng.uniform(0.15, 0.6), rng.uniform(0.5, 1.2), rng.uniform(0.3, 0.7)
    lump(np.array([0, leg + thick / 2, 0]), np.array([thick, thick, long]))
    head = np.array([0, leg + thick * rng.uniform(0.8, 1.5), long * 0.55])
    lump(head, np.full(3, thick * rng.uniform(0.5, 0.9)))
    lump(head + np.array([0, -0.05, thick * 0.35]), np.array([0.25, 0.2, 0.35]) * thick * 1.3)
    lump((head + np.array([0, leg + thick / 2, long * 0.3])) / 2, np.full(3, thick * 0.6))
    for sx in (-1, 1):
        ear = head + np.array([sx * thick * 0.25, thick * 0.35, -0.05])
        lump(ear, np.array([0.12, 0.35, 0.08]) * thick * rng.uniform(0.8, 2))
        for sz in (-1, 1):
            foot = np.array([sx * thick * 0.3, leg * 0.5, sz * long * 0.33])
            lump(foot, np.array([0.28 * thick, leg * 1.3, 0.28 * thick]))
            lump(foot - np.array([0, leg * 0.45, -0.05]), np.array([0.3, 0.15, 0.42]) * thick)
    t = np.linspace(0, 1, 24)[:, None]
    curl = rng.uniform(-1, 1, 3) * 0.6
    tail = (
        np.array([0, leg + thick * 0.6, -long * 0.45]) + t * np.array([0, 0.2, -0.5]) + t**2 * curl
    )
    path = at + (tail * size) @ turn.T
    a.add(tube(path, 0.06 * size * rng.uniform(0.5, 1.3)))


def drapery(rng: Rng) -> Mesh:
    """Hanging and lying cloth with folds, over things."""
    a = Assembly(rng)
    a.floor(14)
    for _ in range(int(rng.integers(2, 6))):
        a.paint()
        wide, high = rng.uniform(1, 3), rng.uniform(1.2, 3)
        at = (rng.uniform(-1.5, 1.5), high, rng.uniform(-1.5, 1.5))
        angle = rng.uniform(0, 6.3)
        a.add(curtain(rng, wide, high), place(at, 1, turn_y(angle)))
        side = turn_y(angle) @ np.array([wide / 2, 0, 0])
        a.bar(np.array(at) - side, np.array(at) + side, 0.06)
    wave = noise(rng, 4, 0.4)
    u = np.linspace(-1.2, 1.2, 60)
    uu, vv = np.meshgrid(u, u)
    ripple = wave(np.stack([uu, 0 * uu, vv], -1).reshape(-1, 3)).reshape(uu.shape)
    cloth = slab(np.stack([uu, 0.35 + 0.25 * ripple, vv], -1), 0.02)
    a.paint()
    a.add(cloth, place((rng.uniform(-1, 1), 0.1, rng.uniform(-1, 1)), rng.uniform(0.7, 1.6)))
    clutter(a, np.zeros(3), 2, 10)
    return a.finish()


def crockery(rng: Rng) -> Mesh:
    """Bowls, cups, vases and plates close together on a table, seen from near."""
    a = Assembly(rng)
    a.floor(8)
    a.paint()
    for _ in range(int(rng.integers(6, 22))):
        a.paint()
        x, z = rng.normal(0, 0.8, 2)
        high = rng.uniform(0.1, 0.9)
        wide = rng.uniform(0.4, 1.3)
        a.add(vase(rng), place((x, 0, z), (wide, high, wide), turn_y(rng.uniform(0, 6))))
    clutter(a, np.zeros(3), 1.5, 8)
    if rng.random() < 0.3:
        a.span((-3, 0, -2), (3, 2, -1.8))
    return a.finish()
