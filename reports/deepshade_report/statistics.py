"""Medians with their spread, ratios within one round, and the Pareto frontier."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

DIGITS = 6


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles (linear interpolation), extremes and number of `values`.

    Raises ValueError without values.
    """
    if not len(values):
        raise ValueError("no values to summarise")
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return {
        "median": significant(middle),
        "quartiles": [significant(low), significant(high)],
        "least": significant(min(values)),
        "most": significant(max(values)),
        "count": len(values),
    }


def ratio(above: Sequence[float], below: Sequence[float]) -> dict[str, Any]:
    """The spread of above/below, pair by pair: what both suffer in one round cancels.

    Rounds that only one of them took part in are left out. Raises ValueError without a pair.
    """
    return spread([a / b for a, b in zip(above, below, strict=False) if b > 0])


def percentile(values: Sequence[float], share: float) -> float:
    """The smallest value that at least `share` (0 to 1) of all values don't exceed."""
    ordered = sorted(values)
    rank = int(np.ceil(share * len(ordered) - 1e-9))
    return ordered[max(1, rank) - 1]


def frontier(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other beats, by rising cost.

    A point (cost, error) is beaten by one that is no worse in both and better in one. Of equal
    points the first counts.
    """
    order = sorted(range(len(points)), key=lambda k: (*points[k], k))
    best = float("inf")
    kept: list[int] = []
    for index in order:
        if points[index][1] < best:
            kept.append(index)
            best = points[index][1]
    return kept


def significant(value: float) -> float:
    """The value with `DIGITS` significant digits, for files that people read."""
    return float(f"{float(value):.{DIGITS}g}")
