"""Directional occlusion along a bent normal.

Intel's XeGTAO 1.30 (F. Strugar and S. McCalla, 2021): GTAO also sums up the directions that it
finds open, weighted by their cosine, and ambient light is looked up along their mean: visibility
times the irradiance of a surface that faces there.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao.gtao import PUBLISHED, QUICK, SETTINGS, march_bent
from deepshade_report.baselines.ao.marching import RANGES, Parameters, openness
from deepshade_report.baselines.do.lit import Lit, open_lit
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.tuning import Tunable, tuned


def bent(slices: int, steps: int, parameters: Parameters | None = None) -> Filter:
    """The bent normal as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**(tuned(__package__, "bent") or vars(PUBLISHED)))
    settings = {"slices": slices, "steps": steps}
    name = "GTAO along a bent normal"
    return Filter(name, settings, parameters, open_lit, _shade, recorded=True)


TUNABLE = Tunable(partial(bent, 3, 6), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method at GTAO's settings, from cheap to best; in a quick report, two of them."""
    return [bent(slices, steps) for slices, steps in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, *given: Any) -> Any:
    found = openness(march_bent, lit.screen, *given)
    towards = mi.Vector3f(found.y, found.z, found.w)
    towards = dr.select(dr.squared_norm(towards) > 0, towards, lit.screen.normal)
    image = dr.clip(found.x, 0, 1) * lit.irradiance(towards)
    return dr.select(lit.screen.depth > 0, image, lit.chain.mean)
