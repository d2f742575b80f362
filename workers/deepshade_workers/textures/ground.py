"""Grass, leaves, gravel, skin: what grows or lies about."""

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
)


def _greens(rng: Rng) -> Field:
    """(3, 3): dark to light leaves, from fresh to dry."""
    light = rng.uniform(0.3, 0.6) * np.array([rng.uniform(0.4, 1.0), 1, rng.uniform(0.1, 0.4)])
    return np.stack([0.15 * light, 0.6 * light, light])


def grass(rng: Rng, size: int) -> Field:
    """Blades over dark ground."""
    blades = strokes(rng, size, 2500, rng.uniform(0.05, 0.12), -np.pi / 2, rng.uniform(0.3, 1.2))
    return shade(0.75 * blades + 0.25 * clouds(rng, size, 2, 1.2), _greens(rng))


def moss(rng: Rng, size: int) -> Field:
    """Cushions of green on stone."""
    field = clouds(rng, size, 2, 1.5)
    stone = shade(clouds(rng, size, 4, 0.9), colours(rng, 3, 0.1))
    green = shade(clouds(rng, size, 12, 0.6), _greens(rng))
    edge = rng.uniform(0.3, 0.7)
    return mix(stone, green, steps(field, edge, edge + 0.15))


def leaves(rng: Rng, size: int) -> Field:
    """Fallen leaves: long cells with shaded edges."""
    first, second, number = cells(rng, size, int(rng.integers(6, 14)))
    palette = np.array([[0.1, 0.05, 0.02], [0.5, 0.25, 0.05], [0.45, 0.4, 0.1], [0.35, 0.1, 0.04]])
    palette = palette * rng.uniform(0.6, 1.5)
    base = shade(0.8 * number + 0.2 * clouds(rng, size, 8, 0.8), palette)
    return base * (0.35 + 0.65 * steps(second - first, 0, 0.3))[..., None]


def gravel(rng: Rng, size: int) -> Field:
    """Pebbles of two sizes."""
    first, second, number = cells(rng, size, int(rng.integers(10, 20)))
    small, _, other = cells(rng, size, int(rng.integers(30, 50)))
    large = steps(first, 0.5, 0.42)
    tone = np.where(number < 0.5, other, number) * (1 - 0.6 * np.where(number < 0.5, small, first))
    pebble = np.maximum(large, (number < 0.5) * steps(small, 0.6, 0.4))
    return shade(tone, colours(rng, 4, 0.3)) * (0.3 + 0.7 * pebble * (second > 0.1))[..., None]


def sand(rng: Rng, size: int) -> Field:
    """Ripples with grain."""
    _, v = grid(size)
    bend = clouds(rng, size, 1, 2.2)
    wave = np.sin(2 * np.pi * (int(rng.integers(4, 14)) * v + rng.uniform(0.5, 2) * bend))
    return shade(0.5 + 0.25 * wave + 0.25 * (clouds(rng, size, 40, 0) - 0.5), colours(rng, 3, 0.08))


def snow(rng: Rng, size: int) -> Field:
    """Bright, with soft blue hollows."""
    field = 0.8 * clouds(rng, size, 1, 2.0) + 0.2 * clouds(rng, size, 30, 0.2)
    return shade(field, np.array([[0.45, 0.5, 0.6], [0.8, 0.82, 0.86], [0.92, 0.92, 0.92]]))


def skin(rng: Rng, size: int) -> Field:
    """Blotches, pores and freckles."""
    base = rng.uniform(0.15, 0.8) * np.array([1, rng.uniform(0.55, 0.75), rng.uniform(0.4, 0.6)])
    tones = np.stack([base * [0.8, 0.6, 0.55], base, np.minimum(base * 1.15, 0.95)])
    first, _, number = cells(rng, size, int(rng.integers(12, 30)))
    freckles = steps(first, 0.3, 0.1) * (number < rng.uniform(0, 0.5))
    field = 0.6 * clouds(rng, size, 2, 1.4) + 0.4 * clouds(rng, size, 30, 0.4)
    return mix(shade(field, tones), tones[0] * 0.7, 0.6 * freckles)


def fur(rng: Rng, size: int) -> Field:
    """Short hairs along one direction, with patches."""
    hair = strokes(rng, size, 4000, 0.06, rng.uniform(0, 2 * np.pi), 0.3)
    patch = steps(clouds(rng, size, 1, 2.2), 0.45, 0.6)
    a, b = shade(hair, colours(rng, 3)), shade(hair, colours(rng, 3))
    return mix(a, b, patch)


def spotted(rng: Rng, size: int) -> Field:
    """A leopard's rosettes."""
    first, _, number = cells(rng, size, int(rng.integers(5, 12)), 0.8)
    wobble = 0.12 * (clouds(rng, size, 6, 1.3) - 0.5)
    ring = steps(np.abs(first + wobble - 0.3), 0.12, 0.05) * (number > 0.15)
    tones = colours(rng, 3, 0.15)
    base = mix(tones[2], tones[1], steps(first + wobble, 0.3, 0.2))
    return mix(base, 0.1 * tones[0], ring)


def zebra(rng: Rng, size: int) -> Field:
    """Bent stripes that fork."""
    field = clouds(rng, size, rng.uniform(3, 7), 4.0, (1, rng.uniform(1.5, 4)))
    tones = colours(rng, 2)
    return mix(0.1 * tones[0], tones[1], steps(field, 0.45, 0.55))
