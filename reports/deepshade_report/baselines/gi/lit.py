"""A view's surfaces and their light, packed so that one look at a pixel fetches all of either."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.baselines.picture import mi
from deepshade_report.baselines.screen import Screen, open_screen
from deepshade_report.view import View

LEVELS = 5  # of the light, each half as large as the one before


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Lit:
    """Flat Dr.Jit values, four floats a pixel.

    `surface` is normal and depth; `light` radiance and the share of a pixel that has a surface.
    """

    screen: Screen
    surface: Any
    light: Any


def open_lit(view: View) -> Lit:
    """`view` on the device; light that isn't finite, or lies where nothing is, is 0."""
    screen = open_screen(view)
    there = screen.depth.numpy() > 0
    light = np.where(there, view.attributes["light_diffuse"].reshape(3, -1), np.float32(0))
    light = np.where(np.isfinite(light), light, np.float32(0))
    planes = [*screen.normal.numpy(), screen.depth.numpy()]
    surface = np.where(np.isfinite(planes), planes, 0).T
    packed = [np.concatenate([light, there[None]]).T, surface]
    radiance, surface = (mi.Float(np.ascontiguousarray(p, np.float32).ravel()) for p in packed)
    return Lit(screen, surface, radiance)


def pyramid(lit: Lit) -> tuple[Any, Any]:
    """The light at LEVELS sizes in one plane of four floats a pixel; where each begins and its row.

    Each level is the sum of 2 x 2 pixels of the one before, coverage too: their quotient is the
    mean light of what surfaces there are.
    """
    height, width = lit.screen.shape
    parts, starts, rows, source, begin = [lit.light], [0], [width], lit.light, width * height
    for _ in range(1, LEVELS):
        half, low = (width + 1) // 2, (height + 1) // 2
        index = dr.arange(mi.UInt32, half * low)
        row = index // dr.opaque(mi.UInt32, half)
        column = index - row * dr.opaque(mi.UInt32, half)
        wide, high = dr.opaque(mi.UInt32, width), dr.opaque(mi.UInt32, height)
        total = mi.Vector4f(0)
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            c, r = 2 * column + right, 2 * row + down
            total += dr.gather(mi.Vector4f, source, r * wide + c, (c < wide) & (r < high))
        source = dr.ravel(total)
        parts.append(source)
        starts.append(begin)
        rows.append(half)
        begin, width, height = begin + half * low, half, low
    return dr.concat(parts), mi.UInt32([*starts, *rows])
