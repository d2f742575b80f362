"""Directional occlusion as most games have it: ambient occlusion times irradiance.

HBAO and GTAO with what was tuned for `ao`; irradiance is the environment blurred by a cosine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from deepshade_report.baselines.ao import gtao, hbao
from deepshade_report.baselines.ao.marching import Parameters, openness
from deepshade_report.baselines.do.lit import Lit, open_lit
from deepshade_report.baselines.picture import Filter
from deepshade_report.tuning import tuned

_OCCLUSION = "deepshade_report.baselines.ao"  # whose parameters these are


def times_irradiance(
    name: str, settings: dict[str, int], parameters: Parameters, kernel: Callable[..., Any]
) -> Filter:
    """Such a method as a Method, of an occlusion `kernel` and its settings."""

    def shade(lit: Lit, *given: Any) -> Any:
        image = openness(kernel, lit.screen, *given) * lit.irradiance(lit.screen.normal)
        return dr.select(lit.screen.depth > 0, image, lit.chain.mean)

    return Filter(name, settings, parameters, open_lit, shade, recorded=True)


def methods(quick: bool) -> list[Filter]:
    """Both, at their settings of `ao`; in a quick report, fewer."""
    found = []
    for title, module, key, ways in (
        ("HBAO x irradiance", hbao, "hbao", "directions"),
        ("GTAO x irradiance", gtao, "gtao", "slices"),
    ):
        parameters = Parameters(**tuned(_OCCLUSION, key))
        for pair in module.QUICK if quick else module.SETTINGS:
            settings = dict(zip((ways, "steps"), pair, strict=True))
            found.append(times_irradiance(title, settings, parameters, module.march))
    return found
