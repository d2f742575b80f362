"""Architecture and engineering: colonnades, towns, fences, pipes, machines."""

from __future__ import annotations

import numpy as np

from deepshade_workers.scenes.mesh import Mesh
from deepshade_workers.scenes.procedural.assembly import Assembly
from deepshade_workers.scenes.procedural.interiors import clutter
from deepshade_workers.scenes.procedural.primitives import (
    Rng,
    cylinder,
    lathe,
    place,
    torus,
    tube,
    turn_y,
)


def colonnade(rng: Rng) -> Mesh:
    """Columns and arches on a stepped base, with a wall behind and mouldings above."""
    a = Assembly(rng)
    count, gap, high = int(rng.integers(4, 9)), rng.uniform(0.9, 1.8), rng.uniform(2, 4)
    thick = rng.uniform(0.2, 0.5)
    length = count * gap
    for i in range(int(rng.integers(1, 5))):
        reach = 0.3 * (5 - i)
        a.span(
            (-length / 2 - reach, i * 0.15, -2 - reach),
            (length / 2 + reach, i * 0.15 + 0.15, 1 + reach),
        )
    base = 0.6
    a.floor(30)
    radius = [0, 0.6, 0.6, 0.5, 0.45, 0.42, 0.38, 0.5, 0.6, 0.6, 0]
    height = [0, 0, 0.04, 0.07, 0.1, 0.5, 0.9, 0.94, 0.96, 1, 1]
    column = lathe(np.stack([radius, height], 1), int(rng.choice([6, 8, 16, 32])))
    rows = int(rng.integers(1, 4))
    for row in range(rows):
        for i in range(count + 1):
            at = (i * gap - length / 2, base, 0.7 - row * 1.2)
            a.add(column, place(at, (thick, high, thick)))
    arches = rng.random() < 0.6
    for i in range(count):
        center = (i + 0.5) * gap - length / 2
        if arches:
            segments = 10
            for k in range(segments):
                t = np.pi * (k + 0.5) / segments
                x, y = gap / 2 * np.cos(t), gap / 2 * np.sin(t)
                turn = np.array(
                    [[-np.sin(t), np.cos(t), 0], [np.cos(t), np.sin(t), 0], [0, 0, -1.0]]
                )
                a.box((center + x, base + high + y, 0.7), (gap * 0.2, 0.2, thick), turn)
    top = base + high + (gap / 2 + 0.1 if arches else 0)
    for i in range(3):
        a.span(
            (-length / 2 - 0.4 - i * 0.1, top + i * 0.15, -2),
            (length / 2 + 0.4 + i * 0.1, top + i * 0.15 + 0.15, 1 + i * 0.1),
        )
    a.paint()
    a.span((-length / 2 - 1, 0, -2.6), (length / 2 + 1, top, -2.3))
    for i in range(count):
        x = (i + 0.5) * gap - length / 2
        a.span((x - 0.2, base + 0.4, -2.32), (x + 0.2, base + high * 0.6, -2.2))
    clutter(a, np.array([0.0, base, 0]), length / 3, 6)
    return a.finish()


def town(rng: Rng) -> Mesh:
    """Blocks of buildings with windows, ledges and pitched roofs along narrow streets."""
    a = Assembly(rng)
    a.floor(30)
    cells = int(rng.integers(4, 7))
    pitch = rng.uniform(2, 3)
    for i in range(cells):
        for j in range(cells):
            a.paint()
            x, z = (i - cells / 2 + 0.5) * pitch, (j - cells / 2 + 0.5) * pitch
            w, d = rng.uniform(0.5, 0.85, 2) * pitch
            h = rng.uniform(0.8, 4.5)
            a.box((x, h / 2, z), (w, h, d))
            floors, bays = max(1, int(h / 0.6)), int(rng.integers(2, 5))
            proud = rng.uniform(0.03, 0.1)
            for f in range(floors):
                y = (f + 0.5) * h / floors
                if rng.random() < 0.5:
                    a.box((x, (f + 1) * h / floors, z), (w + proud * 2, 0.06, d + proud * 2))
                for k in range(bays):
                    u = ((k + 0.5) / bays - 0.5) * w
                    a.box((x + u, y - 0.15, z + d / 2), (w / bays * 0.6, 0.05, proud * 3))
                    a.box((x + u, y, z - d / 2), (w / bays * 0.5, h / floors * 0.5, proud * 2))
            if rng.random() < 0.5:
                a.add(
                    cylinder(4),
                    place((x, h, z), 1, turn_y(np.pi / 4)) @ place(size=(w * 1.45, 0.01, d * 1.45)),
                )
                roof = lathe(np.array([[0, 0], [0.75, 0], [0, rng.uniform(0.3, 0.9)]]), 4)
                a.add(
                    roof,
                    place((x, h, z), (w, 1, d), None) @ place(size=1, rotation=turn_y(np.pi / 4)),
                )
            else:
                for _ in range(3):
                    at = (x + rng.uniform(-0.3, 0.3) * w, h + 0.15, z + rng.uniform(-0.3, 0.3) * d)
                    a.box(at, rng.uniform(0.1, 0.5, 3))
    return a.finish()


def fences(rng: Rng) -> Mesh:
    """Grids, railings, louvres and lattices over boxes and a floor."""
    a = Assembly(rng)
    a.floor(18)
    for _ in range(int(rng.integers(3, 7))):
        a.paint()
        at = np.array([rng.uniform(-2, 2), 0, rng.uniform(-2, 2)])
        turn = turn_y(float(rng.choice([0, np.pi / 2, rng.uniform(0, 3)])))
        wide, high = rng.uniform(1.5, 4), rng.uniform(0.7, 2.4)
        gap, thick = rng.uniform(0.08, 0.4), rng.uniform(0.015, 0.08)
        kind = rng.integers(4)
        for x in np.arange(-wide / 2, wide / 2, gap):
            if kind == 3:
                lean = turn @ np.array([[0.7, -0.7, 0], [0.7, 0.7, 0], [0, 0, 1.0]])
                a.box(at + turn @ np.array([x, high / 2, 0]), (thick, high * 1.2, thick), lean)
                a.box(at + turn @ np.array([x, high / 2, thick]), (high * 1.2, thick, thick), lean)
            elif kind < 2:
                a.box(at + turn @ np.array([x, high / 2, 0]), (thick, high, thick), turn)
        if kind != 3:
            tilt = turn @ np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
            depth = thick if kind == 0 else gap * 0.9
            for y in np.arange(gap, high, gap if kind != 1 else high * 0.45):
                rotation = tilt if kind == 2 else turn
                size = (wide, thick, depth if kind == 2 else thick)
                a.box(at + turn @ np.array([0, y, 0]), size, rotation)
        for x in (-wide / 2, wide / 2):
            a.box(at + turn @ np.array([x, high / 2, 0]), (0.1, high * 1.05, 0.1), turn)
    clutter(a, np.zeros(3), 2.5, 14)
    if rng.random() < 0.5:
        a.span((-4, 0, -3.2), (4, 3, -3))
    return a.finish()


def pipes(rng: Rng) -> Mesh:
    """Pipes that wander along a grid, with flanges, between walls."""
    a = Assembly(rng)
    a.floor(14)
    a.span((-4, 0, -2.2), (4, 4, -2))
    if rng.random() < 0.5:
        a.span((-4, 0, -2.2), (-3.8, 4, 3))
    steps = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    for _ in range(int(rng.integers(8, 26))):
        a.paint()
        at = np.array([rng.uniform(-3, 3), rng.uniform(0.2, 3), rng.uniform(-1.8, 1.5)])
        thick = rng.uniform(0.06, 0.4)
        sides = int(rng.choice([8, 16, 24]))
        for _ in range(int(rng.integers(3, 9))):
            step = steps[rng.integers(6)] * rng.uniform(0.3, 1.8)
            end = np.clip(at + step, [-3.7, 0.1, -1.9], [3.7, 3.8, 2.5])
            if np.linalg.norm(end - at) < 0.1:
                continue
            a.bar(at, end, thick, sides)
            a.ball(end, thick)
            if rng.random() < 0.4:
                middle = (at + end) / 2
                a.bar(middle, middle + 0.05 * (end - at), thick * 1.4, sides)
            at = end
    for _ in range(int(rng.integers(0, 6))):
        t = np.linspace(0, 1, 40)[:, None]
        knots = rng.uniform([-3, 0.1, -1.8], [3, 3, 1.5], (4, 3))
        curve = (
            (1 - t) ** 3 * knots[0]
            + 3 * t * (1 - t) ** 2 * knots[1]
            + 3 * t**2 * (1 - t) * knots[2]
            + t**3 * knots[3]
        )
        a.add(tube(curve, rng.uniform(0.02, 0.1)))
    return a.finish()


def machines(rng: Rng) -> Mesh:
    """Panels covered with nested boxes, bolts, rings and grooves."""
    a = Assembly(rng)
    panels = [(np.eye(3), np.zeros(3))]
    if rng.random() < 0.6:
        panels.append((np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]), np.array([0, 3.0, -3])))
    if rng.random() < 0.4:
        panels.append((np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([3.0, 3, 0])))
    for turn, origin in panels:
        a.box(origin + turn @ np.array([0, -0.2, 0]), (6.4, 0.4, 6.4), turn)
        for _ in range(int(rng.integers(50, 140))):
            if rng.random() < 0.1:
                a.paint()
            size = rng.uniform(0.1, 1.3, 3) * np.array([1, rng.uniform(0.1, 0.9), 1])
            x, z = rng.uniform(-2.8, 2.8, 2)
            kind = rng.random()
            center = origin + turn @ np.array([x, size[1] / 2, z])
            if kind < 0.6:
                a.box(center, size, turn)
                for _ in range(int(rng.integers(0, 4))):
                    small = size * rng.uniform(0.15, 0.6, 3)
                    offset = np.array([rng.uniform(-0.3, 0.3), 0.5, rng.uniform(-0.3, 0.3)])
                    a.box(center + turn @ (offset * size), small, turn)
            elif kind < 0.85:
                size[2] = size[0]
                a.add(cylinder(int(rng.choice([6, 24]))), place(center, size, turn))
            else:
                a.add(torus(0.2), place(center, (size[0], size[0], size[0]), turn))
    return a.finish()
