"""Bricks, tiles, paving: stones with joints."""

from __future__ import annotations

import numpy as np

from deepshade_workers.textures.patterns import (
    Field,
    Rng,
    any_colours,
    cells,
    clouds,
    colours,
    grid,
    mix,
    rows,
    shade,
    steps,
)


def _laid(rng: Rng, size: int, joint: Field, number: Field, roughness: float) -> Field:
    """Stones of their own shade by `number`, with mortar where `joint` is 1."""
    wear = clouds(rng, size, 4, 1.1)
    stones = shade((1 - roughness) * number + roughness * wear, colours(rng, 4, 0.2))
    mortar = shade(wear, colours(rng, 2, 0.05))
    return mix(stones, mortar, joint)


def bricks(rng: Rng, size: int) -> Field:
    """A running bond."""
    columns = int(rng.integers(2, 7))
    dx, dy, number = rows(rng, size, columns, 2 * columns + 2 * int(rng.integers(0, 2)))
    joint = rng.uniform(0.04, 0.09)
    rough = 0.05 * (clouds(rng, size, 20, 0.8) - 0.5)
    edge = steps(np.minimum(dx, dy) + rough, joint + 0.03, joint)
    return _laid(rng, size, edge, number, 0.4)


def tiles(rng: Rng, size: int) -> Field:
    """Square tiles of one glaze."""
    count = int(rng.integers(2, 10))
    dx, dy, number = rows(rng, size, count, count, 0)
    joint = rng.uniform(0.015, 0.05)
    edge = steps(np.minimum(dx, dy), joint + 0.02, joint)
    return _laid(rng, size, edge, 0.5 + 0.3 * number, rng.uniform(0, 0.4))


def checker(rng: Rng, size: int) -> Field:
    """Two colours by turns."""
    count = 2 * int(rng.integers(1, 7))
    u, v = grid(size)
    odd = ((u * count).astype(int) + (v * count).astype(int)) % 2
    two = any_colours(rng, 2)
    worn = 0.85 + 0.15 * clouds(rng, size, 2, 1.5)
    return np.asarray(two[odd] * worn[..., None])


def hexagons(rng: Rng, size: int) -> Field:
    """Six-sided tiles: cells of points on a lattice with every other row shifted."""
    count = 2 * int(rng.integers(2, 6))
    u, v = grid(size)
    x, y = u * count, v * count
    nearest, second = np.full_like(x, 9.0), np.full_like(x, 9.0)
    number = np.zeros_like(x)
    shades = rng.random((count, count))
    for down in (-1, 0, 1):
        line = np.floor(y) + down
        middle = 0.25 + 0.5 * (line % 2)
        for right in (-1, 0, 1):
            column = np.floor(x) + right
            distance = np.hypot(column + middle - x, line + 0.5 - y)
            closer = distance < nearest
            second = np.where(closer, nearest, np.minimum(second, distance))
            own = shades[line.astype(int) % count, column.astype(int) % count]
            number = np.where(closer, own, number)
            nearest = np.where(closer, distance, nearest)
    return _laid(rng, size, steps(second - nearest, 0.1, 0.05), number, rng.uniform(0, 0.4))


def cobbles(rng: Rng, size: int) -> Field:
    """Round stones, darker toward their edges."""
    first, second, number = cells(rng, size, int(rng.integers(4, 12)), 0.8)
    base = _laid(rng, size, steps(second - first, 0.15, 0.04), number, 0.5)
    return base * (1 - 0.5 * np.clip(first, 0, 1))[..., None]


def flagstones(rng: Rng, size: int) -> Field:
    """Irregular flat stones."""
    first, second, number = cells(rng, size, int(rng.integers(2, 6)))
    return _laid(rng, size, steps(second - first, 0.09, 0.04), number, 0.6)


def mosaic(rng: Rng, size: int) -> Field:
    """Small tiles of a few unrelated colours."""
    count = int(rng.integers(10, 26))
    dx, dy, number = rows(rng, size, count, count, 0)
    palette = any_colours(rng, 5)
    stones = palette[(number * 5).astype(int)]
    return mix(stones, colours(rng, 2)[1], steps(np.minimum(dx, dy), 0.12, 0.05))


def shingles(rng: Rng, size: int) -> Field:
    """Overlapping rounded slates, dark under the edge above."""
    columns = int(rng.integers(3, 9))
    lines = 2 * int(rng.integers(2, 6))
    u, v = grid(size)
    y = v * lines
    line = y.astype(int)
    x = (u * columns + 0.5 * (line % 2)) % columns
    number = rng.random((lines, columns))[line, x.astype(int)]
    shadow = steps(y % 1, 0.3, 0.0) * 0.6 + steps(0.5 - np.abs(x % 1 - 0.5), 0.05, 0.0) * 0.4
    wear = clouds(rng, size, 6, 1.0)
    return shade(0.6 * number + 0.4 * wear, colours(rng, 3)) * (1 - shadow)[..., None]


def panels(rng: Rng, size: int) -> Field:
    """Metal or stone panels with thin grooves and a rivet in each corner."""
    columns, lines = int(rng.integers(1, 4)), 2 * int(rng.integers(1, 3))
    dx, dy, number = rows(rng, size, columns, lines, float(rng.choice([0, 0.5])))
    groove = steps(np.minimum(dx, dy), 0.02, 0.008)
    rivet = steps(np.hypot(dx - 0.08, dy - 0.08), 0.03, 0.02)
    base = shade(0.4 * number + 0.6 * clouds(rng, size, 1, 1.7), colours(rng, 3, 0.05))
    return mix(base, 0.3 * base, np.maximum(groove, 0.7 * rivet))
