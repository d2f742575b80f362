"""A view's surfaces, and the environment around them in camera space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from deepshade_report.baselines.lookup import Chain, open_chain
from deepshade_report.baselines.picture import mi
from deepshade_report.baselines.screen import Screen, open_screen
from deepshade_report.view import View


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Lit:
    """`chain` holds the irradiance, and one lobe more."""

    screen: Screen
    chain: Chain

    def irradiance(self, normal: Any) -> Any:
        """Over π, of a surface with that normal (of any length) that nothing blocks."""
        return self.chain.look(mi.UInt32(0), *self.chain.angles(normal))

    def seen(self, direction: Any) -> Any:
        """Radiance from a direction, blurred by the other lobe."""
        return self.chain.look(mi.UInt32(1), *self.chain.angles(direction))


def open_lit(view: View, octave: int = 0) -> Lit:
    """`view` on the device; the lobe more has the exponent 2 to the power of `octave`."""
    screen = open_screen(view)
    return Lit(screen, open_chain(view, (1, octave + 1), camera_space=True))
