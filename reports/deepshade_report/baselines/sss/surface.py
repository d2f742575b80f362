"""A view's light and how far it scatters, as both methods need them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.baselines.picture import mi
from deepshade_report.baselines.screen import Screen, open_screen
from deepshade_report.view import View


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Surface:
    """Flat Dr.Jit values. `light` (three planes) is radiance; `free` the mean free path, in the
    screen's unit of length, 0 where a channel doesn't scatter.
    """

    screen: Screen
    light: Any
    free: Any


def open_surface(view: View) -> Surface:
    """`view` on the device. A mean free path that isn't finite or positive scatters nothing."""
    screen = open_screen(view)
    there = screen.depth.numpy() > 0
    free = view.attributes["scatter"].reshape(3, -1) / np.float32(view.radius)
    with np.errstate(invalid="ignore"):
        free = np.where(there & (free > 0) & np.isfinite(free), free, np.float32(0))
    light = view.attributes["light"].reshape(3, -1)
    planes = [mi.Color3f(*(mi.Float(np.ascontiguousarray(p)) for p in x)) for x in (light, free)]
    dr.eval(planes)
    return Surface(screen, *planes)
