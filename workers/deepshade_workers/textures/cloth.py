"""Cloth, paper, print: regular patterns of threads and ink."""

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
    shade,
    steps,
)


def _threads(rng: Rng, size: int, base: Field) -> Field:
    """`base` with a fine weave over it."""
    u, v = grid(size)
    count = 2 * int(rng.integers(16, 40))
    over = ((u * count).astype(int) + (v * count).astype(int)) % 2
    thread = np.where(over, np.abs(u * count % 1 - 0.5), np.abs(v * count % 1 - 0.5))
    return base * (1 - 0.5 * thread - 0.1 * clouds(rng, size, 20, 0.5))[..., None]


def weave(rng: Rng, size: int) -> Field:
    """Broad strips over and under each other: a basket."""
    u, v = grid(size)
    count = 2 * int(rng.integers(4, 14))
    x, y = u * count, v * count
    over = (x.astype(int) + y.astype(int)) % 2
    across, along = np.where(over, x % 1, y % 1), np.where(over, y % 1, x % 1)
    light = np.sin(np.pi * across) ** 0.6 * (0.5 + 0.5 * np.sin(np.pi * along))
    number = np.where(over, rng.random(count)[x.astype(int)], rng.random(count)[y.astype(int)])
    return shade(0.3 * number + 0.7 * light, colours(rng, 3, 0.15))


def stripes(rng: Rng, size: int) -> Field:
    """Stripes of several widths and colours."""
    u, v = grid(size)
    edges = np.sort(rng.random(int(rng.integers(3, 9))))
    kinds = rng.integers(4, size=len(edges) + 1)
    kinds[-1] = kinds[0]
    repeat = int(rng.integers(1, 5))
    along = (u + (v if rng.random() < 0.3 else 0)) * repeat % 1
    return _threads(rng, size, any_colours(rng, 4)[kinds[np.searchsorted(edges, along)]])


def plaid(rng: Rng, size: int) -> Field:
    """A tartan: the same stripes both ways, mixed."""
    edges = np.sort(rng.random(int(rng.integers(4, 9))))
    kinds = rng.integers(4, size=len(edges) + 1)
    kinds[-1] = kinds[0]
    sett = any_colours(rng, 4)[kinds]
    repeat = int(rng.integers(1, 4))
    axis = np.searchsorted(edges, (np.arange(size) + 0.5) / size * repeat % 1)
    return _threads(rng, size, 0.5 * (sett[axis][:, None] + sett[axis][None]))


def dots(rng: Rng, size: int) -> Field:
    """Dots on a shifted lattice."""
    u, v = grid(size)
    count = 2 * int(rng.integers(1, 7))
    y = v * count
    x = u * count + 0.5 * (y.astype(int) % 2)
    radius = rng.uniform(0.15, 0.4)
    dot = steps(np.hypot(x % 1 - 0.5, y % 1 - 0.5), radius + 0.03, radius - 0.03)
    back, ink = any_colours(rng, 2)
    return _threads(rng, size, mix(back, ink, dot))


def diamonds(rng: Rng, size: int) -> Field:
    """Argyle: lozenges in two colours with thin lines across."""
    u, v = grid(size)
    count = int(rng.integers(1, 5))
    a, b = (u + v) * count * 2, (u - v) * count * 2
    odd = (np.floor(a) + np.floor(b)) % 2
    line = np.minimum(np.abs((a + 0.5) % 1 - 0.5), np.abs((b + 0.5) % 1 - 0.5))
    back, fill, ink = any_colours(rng, 3)
    return _threads(rng, size, mix(mix(back, fill, odd), ink, steps(line, 0.06, 0.03)))


def zigzag(rng: Rng, size: int) -> Field:
    """Herringbone and chevrons."""
    u, v = grid(size)
    bends, bands = int(rng.integers(2, 10)), int(rng.integers(3, 12))
    wave = v * bands + rng.uniform(0.3, 1) * np.abs(u * bends % 1 - 0.5) * 2
    palette = any_colours(rng, 2)
    return _threads(
        rng, size, mix(palette[0], palette[1], steps(np.abs(wave % 1 - 0.5), 0.22, 0.28))
    )


def scales(rng: Rng, size: int) -> Field:
    """Fans of rings that overlap."""
    u, v = grid(size)
    count = 2 * int(rng.integers(2, 6))
    rings = int(rng.integers(2, 6))
    y = v * count * 2
    line = np.floor(y)
    best = np.full_like(u, -1.0)
    for back in (0, 1):  # the row above overlaps this one
        x = u * count + 0.5 * ((line - back) % 2)
        radius = np.hypot(x % 1 - 0.5, (y % 1 + back) / 2) * 2
        best = np.where((best < 0) & (radius < 1), radius, best)
    field = np.where(best < 0, 0, np.floor(best * rings) / rings)
    return shade(field, any_colours(rng, 3))


def flowers(rng: Rng, size: int) -> Field:
    """Wallpaper: blossoms with petals about scattered centres."""
    u, v = grid(size)
    count = int(rng.integers(2, 6))
    x, y = u * count, v * count
    i, j = x.astype(int), y.astype(int)
    turn = rng.uniform(0, 6, (count, count))[j, i]
    dx, dy = x % 1 - 0.5, y % 1 - 0.5
    petals = int(rng.integers(3, 9))
    rim = 0.3 + 0.13 * np.cos(petals * (np.arctan2(dy, dx) + turn))
    radius = np.hypot(dx, dy)
    back, petal, heart = any_colours(rng, 3)
    blossom = mix(back, petal, steps(radius - rim, 0.02, -0.02))
    return mix(blossom, heart, steps(radius, 0.13, 0.1)) * (
        0.85 + 0.15 * clouds(rng, size, 3, 1.2)[..., None]
    )


def felt(rng: Rng, size: int) -> Field:
    """Fuzzy fibres without direction."""
    field = clouds(rng, size, 10, 0.9) * 0.7 + 0.3 * clouds(rng, size, 50, 0.1)
    return shade(field, colours(rng, 2, 0.1))


def knit(rng: Rng, size: int) -> Field:
    """Rows of V-shaped stitches."""
    u, v = grid(size)
    columns, lines = int(rng.integers(6, 18)), int(rng.integers(8, 24))
    x = u * columns % 1
    y = v * lines + np.abs(x - 0.5) * 1.2
    light = np.sin(np.pi * (y % 1)) * np.abs(np.sin(2 * np.pi * x)) ** 0.4
    band = rng.random(lines)[(v * lines).astype(int)] < 0.3
    a, b = colours(rng, 2, 0.1), colours(rng, 2, 0.1)
    return np.where(band[..., None], shade(light, a), shade(light, b))


def leather(rng: Rng, size: int) -> Field:
    """Small bent wrinkles between pads."""
    first, second, _ = cells(rng, size, int(rng.integers(20, 50)))
    pads = steps(second - first, 0.0, 0.35)
    return shade(0.6 * pads + 0.4 * clouds(rng, size, 2, 1.6), colours(rng, 3, 0.1))
