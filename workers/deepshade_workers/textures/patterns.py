"""What generators of textures are built from; everything repeats at its borders.

Fields are (size, size) float arrays, rows v and columns u, of a unit square; colours are linear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float64]
Rng = np.random.Generator


def grid(size: int) -> tuple[Field, Field]:
    """u and v in (0, 1) of the texels' centres."""
    axis = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(axis, axis)
    return u, v


def clouds(
    rng: Rng, size: int, low: float = 1, slope: float = 1.8, stretch: tuple[float, float] = (1, 1)
) -> Field:
    """Noise of random phases whose amplitude falls as frequency^-slope from `low` waves on.

    Made in the frequency domain, so it repeats. `stretch` > 1 makes it longer along (u, v).
    About uniform in [0, 1].
    """
    fu = np.fft.rfftfreq(size, 1 / size) * stretch[0]
    fv = np.fft.fftfreq(size, 1 / size)[:, None] * stretch[1]
    frequency = np.hypot(fu, fv)
    power = np.where(frequency >= low, np.maximum(frequency, 0.5) ** -slope, 0)
    waves = power * np.exp(2j * np.pi * rng.random(frequency.shape))
    noise = np.fft.irfft2(waves, (size, size))
    noise /= max(float(noise.std()), 1e-12)
    return 1 / (1 + np.exp(-1.7 * noise))  # a normal distribution's own curve, nearly


def steps(x: Field, low: float, high: float) -> Field:
    """0 below `low`, 1 above `high`, smooth between (low > high turns it round)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def cells(rng: Rng, size: int, count: int, jitter: float = 1.0) -> tuple[Field, Field, Field]:
    """Worley's cells of `count`² jittered points: distance to the nearest, to the second, a number.

    Distances in cells; the number is the cell's own in [0, 1). (Worley, SIGGRAPH 1996.)
    """
    u, v = grid(size)
    x, y = u * count, v * count
    i, j = x.astype(int), y.astype(int)
    places = 0.5 + jitter * (rng.random((2, count, count)) - 0.5)
    numbers = rng.random((count, count))
    first, second = np.full_like(x, 9.0), np.full_like(x, 9.0)
    number = np.zeros_like(x)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            row, column = (j + down) % count, (i + right) % count
            dx = i + right + places[0, row, column] - x
            dy = j + down + places[1, row, column] - y
            distance = np.hypot(dx, dy)
            nearer = distance < first
            second = np.where(nearer, first, np.minimum(second, distance))
            number = np.where(nearer, numbers[row, column], number)
            first = np.where(nearer, distance, first)
    return first, second, number


def rows(
    rng: Rng, size: int, columns: int, lines: int, shift: float = 0.5
) -> tuple[Field, Field, Field]:
    """A wall of `columns` x `lines` stones, every other line shifted.

    Returns the distances to a stone's nearest sides along u and v in units of 1 / lines, and its
    own number in [0, 1). `lines` should be even where they are shifted.
    """
    u, v = grid(size)
    y = v * lines
    line = y.astype(int)
    x = (u * columns + shift * (line % 2)) % columns
    number = rng.random((lines, columns))[line, x.astype(int)]
    dx, dy = np.abs(x % 1 - 0.5), np.abs(y % 1 - 0.5)
    return (0.5 - dx) * lines / columns, 0.5 - dy, number


def strokes(rng: Rng, size: int, count: int, length: float, angle: float, spread: float) -> Field:
    """How brightly the last of `count` thin lines is drawn at each texel, 0 where there is none.

    Their lengths are up to `length` of the side, their angles `angle` ± `spread` radians.
    """
    points = max(2, int(length * size * 1.3))
    t = np.linspace(0, 1, points)
    angles = angle + spread * rng.uniform(-1, 1, (count, 1))
    reach = length * size * rng.uniform(0.4, 1, (count, 1)) * t
    bend = rng.uniform(-0.5, 0.5, (count, 1)) * t
    x = (rng.uniform(0, size, (count, 1)) + reach * np.cos(angles + bend)).astype(int) % size
    y = (rng.uniform(0, size, (count, 1)) + reach * np.sin(angles + bend)).astype(int) % size
    drawn = np.zeros((size, size))
    drawn[y, x] = rng.uniform(0.3, 1, (count, 1))
    return drawn


def warped(field: Field, du: Field, dv: Field) -> Field:
    """`field` seen at u + du, v + dv (fractions of the side), the nearest texel."""
    size = len(field)
    index = np.arange(size)
    column = (index[None] + np.rint(du * size).astype(int)) % size
    row = (index[:, None] + np.rint(dv * size).astype(int)) % size
    return np.asarray(field[row, column])


def colours(rng: Rng, count: int, spread: float = 0.25) -> Field:
    """(count, 3) linear reflectances about one random hue, from dark to light."""
    base = rng.uniform(0.25, 0.85) * (1 - rng.uniform(0, 0.75) * rng.random(3))
    light = np.linspace(rng.uniform(0.25, 0.8), 1.1, count)[:, None]
    return np.clip(base * light * (1 + spread * rng.uniform(-1, 1, (count, 3))), 0.01, 0.95)


def any_colours(rng: Rng, count: int) -> Field:
    """(count, 3) unrelated linear reflectances."""
    return rng.uniform(0.1, 0.9, (count, 1)) * (
        1 - rng.uniform(0, 0.9, (count, 1)) * rng.random((count, 3))
    )


def shade(field: Field, palette: Field) -> Field:
    """(size, size, 3): the palette's colours from `field` 0 to 1, mixed between them."""
    at = np.clip(field, 0, 1) * (len(palette) - 1)
    low = np.minimum(at.astype(int), len(palette) - 2)
    part = (at - low)[..., None]
    return np.asarray(palette[low] * (1 - part) + palette[low + 1] * part)


def mix(a: Field, b: Field, share: Field) -> Field:
    """(size, size, 3): `a` where `share` is 0, `b` where it is 1; colours or single ones."""
    share = share[..., None]
    return np.asarray(a * (1 - share) + b * share)
