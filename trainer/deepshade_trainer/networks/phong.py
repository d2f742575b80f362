"""Phong's lobe over a surface, as a few cosine lobes of the whole sphere.

Light from ω is reflected by K(ω) = (n + 2) / (2π) cosⁿα max(0, N·ω), α from the direction R in
which the view is mirrored about N. What K makes of an environment depends on n and on μ = N·R:
where the lobe is clear of the horizon it is nearly μ A(R, n + 1) (A as in
`deepshade.environments.lobes`), and else K is cut off, tilted towards N and flattened. So it is
replaced by lobes that have its moments: one with the same total, mean direction and spread; or
two side by side, which have its width along the horizon and across it as well.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROWS, COLUMNS = 29, 129  # of the table: log2(n + 1) from 0 to 14, and `warped` μ from -1 to 1
_POLAR, _AROUND = 160, 48  # points of the quadrature
_LEAST = 1e-12  # of K's total: below the horizon


def warped(mu: Array, exponent: Array) -> Array:
    """Where μ lies in the table, from -1 to 1: finely about 0, where lobes meet the horizon."""
    stretch = (exponent + 1) / 8
    return np.asarray(mu * np.sqrt((1 + stretch) / (1 + stretch * mu * mu)))


def table(lobes: int) -> NDArray[np.float32]:
    """(4 or 5, ROWS, COLUMNS) of E - max(μ, 0), a, b, log2(m / (n + 1)), and c, where

        ∫ K L dω ≈ E / 2 (A(a R + b N + c N×R, m) + A(a R + b N - c N×R, m)),

    with c = 0 for one lobe, which is left out. The directions' lengths don't matter.
    """
    found = np.zeros((5, ROWS, COLUMNS))
    for row in range(ROWS):
        exponent = 2 ** (row / 2) - 1
        stretch = (exponent + 1) / 8
        t = np.linspace(-1, 1, COLUMNS)
        for column, mu in enumerate(t / np.sqrt(1 + stretch * (1 - t * t))):
            found[:, row, column] = _entry(float(np.clip(mu, -1, 1)), exponent, lobes)
    return found[: 3 + lobes].astype(np.float32)


def _entry(mu: float, exponent: float, lobes: int) -> tuple[float, float, float, float, float]:
    total, along, up, across = _moments(mu, exponent)
    sine = math.sqrt(max(0.0, 1 - mu * mu))
    if total < _LEAST:  # nothing: but what stands beside it is interpolated with it
        return -max(mu, 0.0), 1.0, 1.0, 0.0, 0.0
    length = math.hypot(*along)
    x, z = along[0] / length, along[1] / length
    single = (2 * length - 1) / (1 - length)
    m, spread = single, 0.0
    if lobes == 2 and across > up:
        m, spread = _pair(length, across - up, single)
    # in terms of R = (0, 1) and N = (sine, mu); both components vanish with the sine
    b = x / sine if sine > 1e-6 else 1 / (exponent + 1)
    a = z - b * mu
    c = math.sin(spread) / sine / math.cos(spread) if sine > 1e-6 else 0.0
    return total - max(mu, 0.0), a, b, math.log2(max(m, 1.0) / (exponent + 1)), c


def _pair(length: float, wider: float, least: float) -> tuple[float, float]:
    """(m, ε): two lobes ε to either side have that mean's length, and so much more variance
    across than along.

    A lobe has the mean length (m + 1) / (m + 2) and the variances 1 / (m + 3).
    """

    def spread(m: float) -> float:
        return min(1.0, wider * (m + 3) / m)

    low, high = least, 64 * least + 64
    for _ in range(60):
        m = math.sqrt(low * high)
        if math.sqrt(1 - spread(m)) * (m + 1) / (m + 2) < length:
            low = m
        else:
            high = m
    return low, math.asin(math.sqrt(spread(low)))


def _moments(mu: float, exponent: float) -> tuple[float, tuple[float, float], float, float]:
    """Of K: its total, mean (across and along R, in the plane of N), and variances in that plane
    and across it, about that mean's direction."""
    # cosines so spaced that cosⁿ⁺¹ is even, from the lobe's foot to its top
    cosine = ((np.arange(_POLAR) + 0.5) / _POLAR) ** (1 / (exponent + 1))
    sine = np.sqrt(1 - cosine * cosine)[:, None]
    phi = (np.arange(_AROUND) + 0.5) / _AROUND * math.pi  # the other half is its mirror image
    x, y, z = sine * np.cos(phi), sine * np.sin(phi), cosine[:, None]
    weight = np.maximum(math.sqrt(max(0.0, 1 - mu * mu)) * x + mu * z, 0)
    weight *= (exponent + 2) / (exponent + 1)
    total = float(weight.mean())
    if total < _LEAST:
        return 0.0, (0.0, 1.0), 0.0, 0.0
    weight /= total
    mean = float((weight * x).mean()), float((weight * z).mean())
    length = math.hypot(*mean)
    up = (x * mean[1] - z * mean[0]) / length
    return total, mean, float((weight * up * up).mean()), float((weight * y * y).mean())
