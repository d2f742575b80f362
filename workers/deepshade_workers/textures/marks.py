"""Print and paint: glyph-like marks, gradients, splashes, circuits."""

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
    strokes,
)


def script(rng: Rng, size: int) -> Field:
    """Lines of small random glyphs, as on a printed page."""
    height = int(rng.choice([8, 16, 32]))
    glyphs = rng.random((20, 5, 4)) < 0.45
    lines, columns = size // height, size // max(4, height // 2)
    text = rng.integers(20, size=(lines, columns))
    blank = rng.random((lines, columns)) < 0.18
    page = np.zeros((lines, 8, columns, 5), bool)
    page[:, 1:6, :, :4] = np.where(blank[..., None, None], False, glyphs[text]).transpose(
        0, 2, 1, 3
    )
    small = page.reshape(lines * 8, columns * 5)
    index = (np.arange(size) * len(small)) // size, (np.arange(size) * small.shape[1]) // size
    ink, paper = colours(rng, 2)
    return mix(paper, 0.15 * ink, small[index[0]][:, index[1]].astype(float))


def gradient(rng: Rng, size: int) -> Field:
    """A slow change between colours and back."""
    u, v = grid(size)
    turns = [(1, 0), (0, 1), (1, 1), (1, -1)][rng.integers(4)]
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * (turns[0] * u + turns[1] * v))
    return shade(wave, any_colours(rng, 3))


def speckle(rng: Rng, size: int) -> Field:
    """Fine spots: an eggshell, a lacquer."""
    first, _, number = cells(rng, size, int(rng.integers(20, 60)))
    spots = steps(first, 0.4, 0.2) * (number < rng.uniform(0.2, 0.8))
    base = shade(clouds(rng, size, 1, 2.0), colours(rng, 2, 0.05))
    return mix(base, any_colours(rng, 1)[0], spots)


def splashes(rng: Rng, size: int) -> Field:
    """Paint in drops of several sizes."""
    base = shade(clouds(rng, size, 1, 2), colours(rng, 2, 0.05))
    for count in (3, 8, 18):
        first, _, number = cells(rng, size, count)
        radius = number * rng.uniform(0.2, 0.5)
        base = mix(base, any_colours(rng, 1)[0], steps(first - radius, 0.03, 0) * (number > 0.4))
    return base


def circuit(rng: Rng, size: int) -> Field:
    """Paths at right angles with round ends."""
    count = int(rng.integers(8, 20))
    u, v = grid(size)
    x, y = u * count, v * count
    i, j = x.astype(int), y.astype(int)
    right, down = rng.random((2, count, count)) < 0.45
    dx, dy = x % 1 - 0.5, y % 1 - 0.5
    level = (np.abs(dy) < 0.12) & np.where(dx > 0, right[j, i], right[j, (i - 1) % count])
    upright = (np.abs(dx) < 0.12) & np.where(dy > 0, down[j, i], down[(j - 1) % count, i])
    board, copper, pad = any_colours(rng, 3)
    base = mix(board, copper, (level | upright).astype(float))
    return mix(base, pad, steps(np.hypot(dx, dy), 0.26, 0.2))


def hatching(rng: Rng, size: int) -> Field:
    """Pencil lines in two directions."""
    first = rng.uniform(0, np.pi)
    a = strokes(rng, size, 400, 0.25, first, 0.1)
    b = strokes(rng, size, int(rng.integers(1, 400)), 0.25, first + 1.3, 0.1)
    paper, ink = colours(rng, 2)[1], any_colours(rng, 1)[0]
    return mix(paper, 0.4 * ink, np.maximum(a, b))


def targets(rng: Rng, size: int) -> Field:
    """Rings about scattered centres."""
    first, _, number = cells(rng, size, int(rng.integers(2, 5)), 0.5)
    rings = np.floor(first * rng.uniform(4, 12) + number * 3) % 3
    return np.asarray(any_colours(rng, 3)[rings.astype(int)])


def static(rng: Rng, size: int) -> Field:
    """Square cells of random colours, from coarse to as fine as texels."""
    count = int(rng.choice([8, 16, 32, 64, 128]))
    cellwise = shade(rng.random((count, count)), any_colours(rng, 4))
    index = np.arange(size) * count // size
    return np.asarray(cellwise[index][:, index])


def smears(rng: Rng, size: int) -> Field:
    """Broad brush strokes."""
    field = (
        clouds(rng, size, 2, 1.6, (1, 6))
        if rng.random() < 0.5
        else clouds(rng, size, 2, 1.6, (6, 1))
    )
    return shade(field, any_colours(rng, 4))
