"""Wood: boards, planks, parquet, bark."""

from __future__ import annotations

import numpy as np

from deepshade_workers.textures.patterns import (
    Field,
    Rng,
    cells,
    clouds,
    grid,
    mix,
    rows,
    shade,
    steps,
)


def _browns(rng: Rng) -> Field:
    """(3, 3): dark to light wood."""
    light = rng.uniform(0.25, 0.75) * np.array([1, rng.uniform(0.55, 0.8), rng.uniform(0.25, 0.6)])
    return np.stack([light * rng.uniform(0.3, 0.6), light * 0.8, light])


def _grain(rng: Rng, size: int, stretch: float) -> Field:
    """Fibres along v, of noise stretched along it."""
    slow, fine = clouds(rng, size, 2, 1.4, (1, stretch)), clouds(rng, size, 30, 0.5, (1, stretch))
    return 0.65 * slow + 0.35 * fine


def board(rng: Rng, size: int) -> Field:
    """One board whose year rings show as long waves."""
    u, _ = grid(size)
    bend = clouds(rng, size, 1, 2.4, (1, rng.uniform(3, 8)))
    rings = np.abs(np.sin(np.pi * (int(rng.integers(2, 9)) * u + rng.uniform(2, 7) * bend)))
    return shade(0.7 * rings + 0.3 * _grain(rng, size, 25), _browns(rng))


def planks(rng: Rng, size: int) -> Field:
    """Boards side by side with dark gaps, each of its own shade."""
    columns = int(rng.integers(3, 9))
    across, along, number = rows(rng, size, columns, int(rng.choice([2, 4])))
    base = shade(0.6 * _grain(rng, size, 20) + 0.4 * number, _browns(rng))
    lines = 1 / columns
    gap = np.maximum(steps(across * lines, 0.006, 0.002), steps(along, 0.012, 0.004))
    return mix(base, 0.15 * base, gap)


def parquet(rng: Rng, size: int) -> Field:
    """Squares of short boards, laid across each other by turns."""
    squares, strips = int(rng.choice([2, 4, 6])), int(rng.integers(3, 7))
    u, v = grid(size)
    turned = (u * squares).astype(int) % 2 != (v * squares).astype(int) % 2
    x = np.where(turned, v, u) * squares * strips
    tone = rng.random((2, squares * strips, squares))
    other = np.where(turned, u, v) * squares
    number = tone[turned.astype(int), x.astype(int), other.astype(int)]
    grain = np.where(turned, _grain(rng, size, 20).T, _grain(rng, size, 20))
    gap = steps(0.5 - np.abs(x % 1 - 0.5), 0.06, 0.0)
    base = shade(0.6 * grain + 0.4 * number, _browns(rng))
    return mix(base, 0.3 * base, gap)


def bark(rng: Rng, size: int) -> Field:
    """Deep furrows along the trunk."""
    ridges = np.abs(clouds(rng, size, 3, 1.5, (1, rng.uniform(3, 7))) - 0.5) * 2
    fine = clouds(rng, size, 15, 0.7)
    return shade(0.75 * ridges**0.7 + 0.25 * fine, _browns(rng))


def endgrain(rng: Rng, size: int) -> Field:
    """Sawn logs seen from their ends: rings in cells."""
    first, second, number = cells(rng, size, int(rng.integers(3, 7)), 0.6)
    rings = np.abs(np.sin(first * rng.uniform(20, 45) + 6 * number))
    base = shade(0.6 * rings + 0.4 * clouds(rng, size, 10, 0.8), _browns(rng))
    return mix(base, 0.2 * base, steps(second - first, 0.12, 0.05))


def chipboard(rng: Rng, size: int) -> Field:
    """Pressed chips of wood."""
    _, _, coarse = cells(rng, size, int(rng.integers(18, 40)))
    _, _, fine = cells(rng, size, int(rng.integers(40, 80)))
    return shade(0.6 * coarse + 0.4 * fine, _browns(rng))
