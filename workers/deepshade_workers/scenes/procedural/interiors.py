"""Rooms, corridors, furniture, stairs: what people build to live in."""

from __future__ import annotations

import numpy as np

from deepshade_workers.scenes.mesh import Floats, Mesh
from deepshade_workers.scenes.procedural.assembly import Assembly
from deepshade_workers.scenes.procedural.primitives import (
    Rng,
    cylinder,
    grid_faces,
    lathe,
    place,
    random_solid,
    slab,
    turn_y,
)


def shell(a: Assembly, width: float, height: float, depth: float, wall: float = 0.2) -> None:
    """Six walls around a room whose floor is at 0, with door and window openings in some."""
    rng = a.rng
    x, z = width / 2, depth / 2
    a.span((-x - wall, -wall, -z - wall), (x + wall, 0, z + wall))
    a.span((-x - wall, height, -z - wall), (x + wall, height + wall, z + wall))
    for axis, at, span in ((0, -x, z), (0, x, z), (2, -z, x), (2, z, x)):
        out = at + np.sign(at) * wall
        low, high = sorted((at, out))
        opening = rng.random() < 0.6
        if not opening:
            _wall(a, axis, low, high, -span - wall, span + wall, 0, height)
            continue
        left = rng.uniform(-0.8, 0.2) * span
        right = left + rng.uniform(0.2, 0.7) * span
        sill = 0.0 if rng.random() < 0.4 else rng.uniform(0.2, 0.4) * height
        lintel = rng.uniform(0.65, 0.9) * height
        _wall(a, axis, low, high, -span - wall, left, 0, height)
        _wall(a, axis, low, high, right, span + wall, 0, height)
        _wall(a, axis, low, high, left, right, lintel, height)
        if sill:
            _wall(a, axis, low, high, left, right, 0, sill)
            middle = (left + right) / 2
            _wall(a, axis, low + 0.08, high - 0.08, middle - 0.04, middle + 0.04, sill, lintel)


def _wall(
    a: Assembly, axis: int, low: float, high: float, u0: float, u1: float, y0: float, y1: float
) -> None:
    if axis == 0:
        a.span((low, y0, u0), (high, y1, u1))
    else:
        a.span((u0, y0, low), (u1, y1, high))


def table(a: Assembly, at: Floats, angle: float, width: float, depth: float, high: float) -> None:
    """A table: a top on four legs, perhaps with aprons."""
    rng, turn = a.rng, turn_y(angle)
    thick, leg = rng.uniform(0.03, 0.08), rng.uniform(0.05, 0.1)
    part = a.boxes_at(at, turn)
    part((0, high - thick / 2, 0), (width, thick, depth))
    for sx in (-1, 1):
        for sz in (-1, 1):
            x, z = sx * (width - leg) / 2 * 0.95, sz * (depth - leg) / 2 * 0.95
            part((x, (high - thick) / 2, z), (leg, high - thick, leg))
    if rng.random() < 0.6:
        for sz in (-1, 1):
            z = sz * (depth - leg) / 2 * 0.95
            part((0, high - thick - 0.06, z), (width * 0.9, 0.12, 0.03))


def chair(a: Assembly, at: Floats, angle: float) -> None:
    """A chair: a small table with a slatted or solid back."""
    rng, turn = a.rng, turn_y(angle)
    seat = rng.uniform(0.4, 0.55)
    table(a, at, angle, 0.5, 0.5, seat)
    slats = int(rng.integers(1, 6))
    for i in range(slats):
        y = seat + 0.5 * (i + 0.5) / slats
        a.box(at + turn @ np.array([0, y, -0.23]), (0.46, 0.45 / slats * 0.6, 0.03), turn)
    for sx in (-1, 1):
        a.box(at + turn @ np.array([0.22 * sx, seat + 0.25, -0.23]), (0.04, 0.5, 0.04), turn)


def shelf(a: Assembly, at: Floats, angle: float, width: float, high: float) -> None:
    """A case of shelves, partly filled with books and odd things."""
    rng, turn, depth = a.rng, turn_y(angle), a.rng.uniform(0.25, 0.45)
    wall = 0.04
    part = a.boxes_at(at, turn)
    for sx in (-1, 1):
        part((sx * (width - wall) / 2, high / 2, 0), (wall, high, depth))
    part((0, high / 2, -depth / 2), (width, high, wall / 2))
    boards = int(rng.integers(3, 7))
    for i in range(boards):
        y = wall / 2 + i * (high - wall) / (boards - 1)
        part((0, y, 0), (width, wall, depth))
        if i == boards - 1:
            break
        room = (high - wall) / (boards - 1) - wall
        x = -width / 2 + wall
        while x < width / 2 - 0.12:
            thick = rng.uniform(0.03, 0.1)
            if rng.random() < 0.7:
                tall = room * rng.uniform(0.5, 0.95)
                part((x + thick / 2, y + tall / 2, 0), (thick * 0.9, tall, depth * 0.7))
            x += thick if rng.random() < 0.85 else rng.uniform(0.1, 0.5)


def sofa(a: Assembly, at: Floats, angle: float, width: float) -> None:
    """A sofa: a seat with cushions, a back and two arms."""
    rng, turn = a.rng, turn_y(angle)
    part = a.boxes_at(at, turn)
    part((0, 0.25, 0), (width, 0.3, 0.85))
    part((0, 0.6, -0.36), (width, 0.6, 0.18))
    for sx in (-1, 1):
        part((sx * (width / 2 + 0.08), 0.35, 0), (0.18, 0.6, 0.9))
    seats = int(rng.integers(2, 4))
    for i in range(seats):
        x = width * ((i + 0.5) / seats - 0.5)
        a.add(
            random_cushion(),
            place(at + turn @ np.array([x, 0.47, 0.05]), 1, turn)
            @ place(size=(width / seats * 0.97, 0.18, 0.7)),
        )
        a.add(
            random_cushion(),
            place(at + turn @ np.array([x, 0.72, -0.2]), 1, turn)
            @ place(size=(width / seats * 0.9, 0.45, 0.18)),
        )


def random_cushion() -> Mesh:
    """A rounded unit box: a superellipsoid."""
    u = np.linspace(-np.pi / 2, np.pi / 2, 13)
    v = np.linspace(0, 2 * np.pi, 24, endpoint=False)

    def power(value: Floats) -> Floats:
        return np.sign(value) * np.abs(value) ** 0.4

    cu, su = power(np.cos(u))[:, None], power(np.sin(u))[:, None]
    x = 0.5 * cu * power(np.sin(v))
    z = 0.5 * cu * power(np.cos(v))
    y = np.broadcast_to(0.5 * su, x.shape)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return Mesh.build(vertices, grid_faces(13, 24, wrap=True), crease=60)


def vase(rng: Rng, points: int = 12) -> Mesh:
    """A hollow turned vessel of height 1: vase, bowl or cup."""
    t = np.linspace(0, 1, points)
    radius = 0.25 + 0.12 * np.sin(t * rng.uniform(2, 7) + rng.uniform(0, 6))
    radius += rng.uniform(-0.1, 0.3) * t
    radius = np.maximum(radius, 0.06)
    wall = rng.uniform(0.02, 0.05)
    outside = np.stack([radius, t], 1)
    inside = np.stack([np.maximum(radius - wall, 0.02), np.maximum(t, wall)], 1)[::-1]
    profile = np.concatenate([[[0, 0]], outside, inside, [[0, wall]]])
    return lathe(profile, 32)


def curtain(rng: Rng, width: float, high: float) -> Mesh:
    """A hanging folded cloth, centred on its top edge's middle."""
    u = np.linspace(0, 1, 96)
    v = np.linspace(0, 1, 16)
    folds, depth = rng.uniform(4, 12), rng.uniform(0.04, 0.14)
    phase = rng.uniform(0, 6, 2)
    uu, vv = np.meshgrid(u, v)
    sway = np.sin(2 * np.pi * folds * uu + phase[0] + np.sin(3 * uu + phase[1]))
    z = depth * sway * (0.4 + 0.6 * vv) + 0.05 * np.sin(4 * vv + phase[1])
    x = (uu - 0.5) * width * (1 - 0.1 * np.sin(np.pi * vv))
    return slab(np.stack([x, -vv * high, z], -1), 0.01)


def clutter(a: Assembly, at: Floats, spread: float, count: int) -> None:
    """Small things standing on a surface around `at`."""
    rng = a.rng
    for _ in range(count):
        size = rng.uniform(0.05, 0.25)
        x, z = rng.uniform(-spread, spread, 2)
        a.paint()
        if rng.random() < 0.4:
            a.add(vase(rng), place(at + np.array([x, 0, z]), size))
        else:
            a.add(random_solid(rng), place(at + np.array([x, size / 2, z]), size))


def room(rng: Rng) -> Mesh:
    """A furnished room, seen from inside."""
    a = Assembly(rng)
    width, depth, height = rng.uniform(3.5, 8), rng.uniform(3.5, 8), rng.uniform(2.3, 3.5)
    shell(a, width, height, depth)
    for _ in range(int(rng.integers(5, 14))):
        a.paint()
        furnish(a, np.array([rng.uniform(-0.4, 0.4) * width, 0, rng.uniform(-0.4, 0.4) * depth]))
    for side in (-1, 1):
        along_wall = rng.uniform(-0.3, 0.3) * width
        at = np.array([along_wall, 0, side * (depth / 2 - 0.22)])
        a.paint()
        shelf(a, at, 0 if side < 0 else np.pi, rng.uniform(0.6, 2), rng.uniform(0.8, 2.1))
        if rng.random() < 0.6:
            cloth = curtain(rng, rng.uniform(0.6, 1.8), height * 0.95)
            x = rng.uniform(-0.4, 0.4) * width
            a.add(cloth, place((x, height * 0.97, -side * (depth / 2 - 0.2))))
    if rng.random() < 0.4:
        for x in np.arange(-width / 2, width / 2, rng.uniform(0.6, 1.2)):
            a.span((x, height - 0.2, -depth / 2), (x + 0.14, height, depth / 2))
    return a.finish()


def furnish(a: Assembly, at: Floats) -> None:
    """One piece of furniture at a place on the floor."""
    rng = a.rng
    angle = float(rng.choice([0, np.pi / 2, np.pi, rng.uniform(0, 6.3)]))
    kind = rng.integers(6)
    if kind == 0:
        high = rng.uniform(0.4, 0.9)
        table(a, at, angle, rng.uniform(0.6, 1.8), rng.uniform(0.5, 1), high)
        clutter(a, at + np.array([0, high, 0]), 0.3, int(rng.integers(1, 6)))
    elif kind == 1:
        chair(a, at, angle)
    elif kind == 2:
        shelf(a, at, angle, rng.uniform(0.5, 1.4), rng.uniform(0.6, 2))
    elif kind == 3:
        sofa(a, at, angle, rng.uniform(1, 2.4))
    elif kind == 4:
        size = rng.uniform(0.3, 0.9, 3)
        a.box(at + np.array([0, size[1] / 2, 0]), size, turn_y(angle))
    else:
        clutter(a, at, 0.6, int(rng.integers(2, 8)))


def furniture(rng: Rng) -> Mesh:
    """Furniture crowded and stacked on an open floor."""
    a = Assembly(rng)
    a.floor(16)
    spots = rng.uniform(-2.2, 2.2, (int(rng.integers(10, 24)), 2))
    for x, z in spots:
        a.paint()
        level = float(rng.choice([0, 0, 0, 0.8]))
        if level:
            a.box((x, level / 2, z), (1.0, level, 1.0))
        furnish(a, np.array([x, level, z]))
    return a.finish()


def stairs(rng: Rng) -> Mesh:
    """Straight and spiral stairs with landings and railings."""
    a = Assembly(rng)
    a.floor(20)
    steps = int(rng.integers(8, 20))
    rise, run = rng.uniform(0.14, 0.22), rng.uniform(0.22, 0.4)
    wide = rng.uniform(0.9, 2.5)
    if rng.random() < 0.4:
        inner, sweep = rng.uniform(0.1, 0.6), rng.uniform(0.2, 0.45)
        a.add(cylinder(), place((0, steps * rise / 2, 0), (2 * inner, steps * rise + 1, 2 * inner)))
        for i in range(steps * 2):
            turn = turn_y(i * sweep)
            center = turn @ np.array([inner + wide / 2, (i + 0.5) * rise, 0])
            a.box(center, (wide, rise * rng.uniform(0.3, 0.9), run * 2), turn)
            a.bar(center, center + np.array([0, 0.9, 0]), 0.04)
    else:
        solid = rng.random() < 0.6
        for i in range(steps):
            low = 0.0 if solid else (i + 0.7) * rise
            a.span((-wide / 2, low, -i * run - run), (wide / 2, (i + 1) * rise, -i * run))
            if i % 2 == 0:
                for x in (-wide / 2 + 0.05, wide / 2 - 0.05):
                    foot = np.array([x, (i + 1) * rise, -(i + 0.5) * run])
                    a.bar(foot, foot + np.array([0, 0.9, 0]), 0.05, 8)
        for x in (-wide / 2 + 0.05, wide / 2 - 0.05):
            top = np.array([x, steps * rise + 0.9, -(steps - 0.5) * run])
            a.bar(np.array([x, rise + 0.9, -0.5 * run]), top, 0.08, 8)
        a.paint()
        a.span((-4, 0, -steps * run - 4), (4, steps * rise, -steps * run))
        if rng.random() < 0.7:
            a.span((wide / 2 + 0.02, 0, -8), (wide / 2 + 0.3, steps * rise + 2, 2))
    clutter(a, np.array([0.0, 0, 1]), 2, 8)
    return a.finish()


def level(rng: Rng) -> Mesh:
    """A game-like level: a maze of rooms with floors and ceilings at several heights."""
    a = Assembly(rng)
    cells, size = int(rng.integers(7, 12)), rng.uniform(1.2, 2.5)
    floor = np.round(rng.uniform(0, 4, (cells, cells))) * 0.35
    solid = rng.random((cells, cells)) < 0.28
    roof = 3.0 + np.round(rng.uniform(0, 3, (cells, cells))) * 0.5
    for i in range(cells):
        for j in range(cells):
            x, z = (i - cells / 2) * size, (j - cells / 2) * size
            top = 5.0 if solid[i, j] else float(floor[i, j])
            a.span((x, -1, z), (x + size, top, z + size))
            if not solid[i, j] and rng.random() < 0.6:
                a.span((x, float(roof[i, j]), z), (x + size, 5.5, z + size))
            if not solid[i, j] and rng.random() < 0.3:
                _fixture(a, x + size / 2, float(floor[i, j]), z + size / 2, size)
    wall = cells * size / 2
    for s in (-1, 1):
        a.span((s * wall, -1, -wall), (s * (wall + 0.3), 5.5, wall))
        a.span((-wall, -1, s * wall), (wall, 5.5, s * (wall + 0.3)))
    return a.finish()


def _fixture(a: Assembly, x: float, y: float, z: float, size: float) -> None:
    """A crate, pillar, lamp or beam in one cell of a level."""
    rng = a.rng
    kind = rng.integers(4)
    a.paint()
    if kind == 0:
        side = rng.uniform(0.3, 0.6) * size
        a.box((x, y + side / 2, z), (side, side, side), turn_y(rng.uniform(0, 1.5)))
        if rng.random() < 0.5:
            a.box((x, y + side * 1.3, z), (side * 0.6,) * 3, turn_y(rng.uniform(0, 1.5)))
    elif kind == 1:
        a.add(cylinder(int(rng.choice([6, 8, 24]))), place((x, y + 1.5, z), (0.4, 3, 0.4)))
        a.box((x, y + 0.1, z), (0.6, 0.2, 0.6))
    elif kind == 2:
        a.box((x, y + 1.8, z), (size, 0.2, 0.25))
        a.box((x, y + 1.8, z), (0.25, 0.2, size))
    else:
        ramp = np.array([[1, 0.3, 0], [-0.3, 1, 0], [0, 0, 1.0]])
        a.box((x, y + 0.1, z), (size, 0.2, size * 0.8), ramp)
