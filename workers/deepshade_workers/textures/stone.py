"""Stone, plaster, metal: what is made by noise."""

from __future__ import annotations

import numpy as np

from deepshade_workers.textures.patterns import (
    Field,
    Rng,
    cells,
    clouds,
    colours,
    grid,
    mix,
    shade,
    steps,
    strokes,
    warped,
)


def marble(rng: Rng, size: int) -> Field:
    """Veins: a wave bent by noise (Perlin, SIGGRAPH 1985)."""
    u, v = grid(size)
    turns = rng.integers(-3, 4, 2)
    wave = turns[0] * u + (turns[1] or 1) * v + rng.uniform(1, 4) * clouds(rng, size, 1, 1.9)
    vein = np.abs(np.sin(np.pi * np.rint(turns.any() + 0.0) * wave))
    return shade(vein ** rng.uniform(0.2, 0.8), colours(rng, 3))


def granite(rng: Rng, size: int) -> Field:
    """Grains of a few minerals."""
    _, _, number = cells(rng, size, int(rng.integers(40, 90)))
    return shade(number ** rng.uniform(0.5, 2), colours(rng, 4, 0.5))


def sandstone(rng: Rng, size: int) -> Field:
    """Layers with grain."""
    layers = clouds(rng, size, 1, 1.3, (12, 1))
    return shade(0.75 * layers + 0.25 * clouds(rng, size, 30, 0.3), colours(rng, 4, 0.15))


def plaster(rng: Rng, size: int) -> Field:
    """Nearly even, with stains and grain."""
    field = 0.5 * clouds(rng, size, 1, 2.2) + 0.3 * clouds(rng, size, 20, 0.8)
    return shade(0.5 + 0.5 * field, colours(rng, 3, 0.08))


def concrete(rng: Rng, size: int) -> Field:
    """Grey clouds with pores."""
    first, _, number = cells(rng, size, int(rng.integers(16, 40)))
    pores = steps(first, 0.18, 0.08) * (number < 0.3)
    base = shade(0.4 + 0.6 * clouds(rng, size, 1, 1.4), colours(rng, 3, 0.05))
    return mix(base, 0.4 * base, pores)


def cracked(rng: Rng, size: int) -> Field:
    """Dry ground: cells with dark bent cracks between them."""
    first, second, number = cells(rng, size, int(rng.integers(4, 10)))
    bend = 0.06 * (clouds(rng, size, 3, 1.6) - 0.5)
    gap = warped(second - first, bend, bend.T)
    crack = steps(gap, rng.uniform(0.06, 0.15), 0.01)
    base = shade(0.5 * clouds(rng, size, 2, 1.2) + 0.5 * number, colours(rng, 3, 0.1))
    return mix(base, 0.2 * base, crack)


def rust(rng: Rng, size: int) -> Field:
    """A coat of paint that flakes off what rusts below."""
    paint = shade(clouds(rng, size, 2, 1.5), colours(rng, 2, 0.1))
    field = clouds(rng, size, 2, 1.6)
    below = shade(clouds(rng, size, 5, 1.0), np.array([[0.06, 0.02, 0.01], [0.4, 0.16, 0.05]]))
    edge = rng.uniform(0.4, 0.75)
    return mix(paint, below, steps(field, edge, edge + 0.04))


def brushed(rng: Rng, size: int) -> Field:
    """Metal brushed in one direction."""
    field = clouds(rng, size, 1, 0.5, (1, 60) if rng.random() < 0.5 else (60, 1))
    return shade(0.3 + 0.7 * field, colours(rng, 2, 0.05))


def scratched(rng: Rng, size: int) -> Field:
    """An even surface with scratches in all directions."""
    base = shade(clouds(rng, size, 1, 2.0), colours(rng, 2, 0.05))
    marks = strokes(rng, size, int(rng.integers(30, 200)), rng.uniform(0.1, 0.5), 0, np.pi)
    return mix(base, np.minimum(base * rng.choice([0.4, 1.8]), 0.95), 0.7 * marks)


def terrazzo(rng: Rng, size: int) -> Field:
    """Chips of several colours in an even ground."""
    first, second, number = cells(rng, size, int(rng.integers(10, 28)))
    chips = shade(number, colours(rng, 5, 0.6))
    ground = colours(rng, 2)[1]
    return mix(chips, ground, steps(second - first, 0.35, 0.2) + (number < 0.3)).clip(0, 1)


def camouflage(rng: Rng, size: int) -> Field:
    """Flat patches: noise in a few levels."""
    levels = int(rng.integers(3, 6))
    field = np.floor(clouds(rng, size, 2, 2.2) * levels) / (levels - 1)
    return shade(field, colours(rng, levels, 0.5))
