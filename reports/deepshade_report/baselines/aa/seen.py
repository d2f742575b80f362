"""What the edge filters share: a picture as it is seen, where edges are looked for.

Light is exposed so that its 99th percentile is 1, clipped, and encoded as sRGB (IEC 61966-2-1).
Only edges are found there; what is blended is linear light. The factor of exposure is known to a
renderer, so it isn't part of shading a frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade import metrics
from deepshade_report.baselines.picture import Grid, light, mi, plain
from deepshade_report.view import View


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Lit:
    """A view on the device: light, its factor of exposure, 1 / depth (0 in background)."""

    grid: Grid
    light: Any
    factor: Any
    nearness: Any


def upload(view: View) -> Lit:
    """`view` on the device."""
    planes = np.nan_to_num(view.attributes["light"], posinf=0.0, neginf=0.0)
    depth = view.attributes["depth"][0]
    there = ~view.background & (depth > 0)
    nearness = plain(np.where(there, 1 / np.where(there, depth, 1), 0))
    factor = dr.opaque(mi.Float, metrics.exposure(planes))
    return Lit(Grid.of(view.height, view.width), light(planes), factor, nearness)


def encoded(lit: Lit) -> Any:
    """The colour as it is seen, 0 to 1."""
    exposed = dr.clip(lit.light * lit.factor, 0, 1)
    curved = 1.055 * dr.power(dr.maximum(exposed, 1e-6), 1 / 2.4) - 0.055
    return dr.select(exposed <= 0.0031308, 12.92 * exposed, curved)


def luma(colour: Any) -> Any:
    """Luma of an encoded colour (Rec. 709)."""
    return dr.dot(colour, mi.Color3f(0.2126, 0.7152, 0.0722))
