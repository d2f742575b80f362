"""Places on a circle of pixels: where the perceptron of a mesh looks (`docs/perceptron.md`)."""

from __future__ import annotations

import math

POINTS = 16
RADIUS = 10  # pixels


def offsets(radius: int = RADIUS) -> list[tuple[int, int]]:
    """(columns right, rows down) of the nearest pixels to `POINTS` places, from the right on.

    They go counter-clockwise as seen: the second is up and right. A radius of 0 gives 16 times
    the pixel itself.
    """
    turns = [2 * math.pi * k / POINTS for k in range(POINTS)]
    return [(round(radius * math.cos(t)), -round(radius * math.sin(t))) for t in turns]
