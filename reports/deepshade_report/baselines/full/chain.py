"""Full shading as an engine would: image-based light, times ambient occlusion, through a lens.

The split sum of `ibl`, GTAO of `ao` and the ring gather of `dof`, one after the other on the
device, with what was tuned for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao import gtao
from deepshade_report.baselines.ao.marching import Parameters as Marching
from deepshade_report.baselines.ao.marching import openness
from deepshade_report.baselines.dof import rings
from deepshade_report.baselines.ibl import splitsum
from deepshade_report.baselines.picture import Filter, Grid, plain
from deepshade_report.baselines.screen import Screen, open_screen
from deepshade_report.tuning import tuned
from deepshade_report.view import View

# mips, slices, steps, rings, and whether these are at half resolution, from cheap to best
SETTINGS = (
    (5, 1, 2, 3, True),
    (5, 2, 4, 4, True),
    (9, 3, 6, 4, False),
    (16, 6, 8, 6, False),
    (16, 9, 12, 8, False),
)
QUICK = (SETTINGS[1], SETTINGS[2])
_BASELINES = "deepshade_report.baselines"


@dataclass(frozen=True)
class Parameters:
    """Those of the three."""

    reflections: splitsum.Parameters
    occlusion: Marching
    lens: rings.Parameters


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Frame:
    """A view on the device."""

    surface: splitsum.Surface
    screen: Screen
    grid: Grid
    radius: Any


def chain(
    mips: int,
    slices: int,
    steps: int,
    ring_count: int,
    half: bool,
    parameters: Parameters | None = None,
) -> Filter:
    """The chain as a Method, with what was tuned for each part or the parameters given."""
    parameters = parameters or Parameters(
        splitsum.Parameters(**tuned(f"{_BASELINES}.ibl", "splitsum")),
        Marching(**tuned(f"{_BASELINES}.ao", "gtao")),
        rings.Parameters(**tuned(f"{_BASELINES}.dof", "rings")),
    )
    settings = {"mips": mips, "slices": slices, "steps": steps, "rings": ring_count, "half": half}
    name = "split sum + GTAO + ring gather"
    return Filter(name, settings, parameters, partial(_open, mips), _shade, recorded=True)


def methods(quick: bool) -> list[Filter]:
    """The chain at its settings, from cheap to best; in a quick report, two of them."""
    return [chain(*counts) for counts in (QUICK if quick else SETTINGS)]


def _open(mips: int, view: View) -> Frame:
    radius = plain(view.attributes["focal"][0] / 2)
    grid = Grid.of(view.height, view.width)
    return Frame(splitsum.open_surface(mips, view), open_screen(view), grid, radius)


def _shade(
    frame: Frame, mips: int, slices: int, steps: int, ring_count: int, half: bool, *given: Any
) -> Any:
    reflections, occlusion, lens = given
    light = splitsum.reflected(frame.surface, mips, *reflections)
    light *= openness(gtao.march, frame.screen, slices, steps, *occlusion)
    dr.eval(light)
    return rings.shade((frame.grid, light, frame.radius), ring_count, half, *lens)
