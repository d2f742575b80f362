"""What one screen-space effect takes, gives and means: a row of the table of effects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from deepshade.attributes import ATTRIBUTES
from deepshade.effects.settings import Setting
from deepshade.symmetry import ALL

RGB = ("R", "G", "B")
IRRADIANCE = "irradiance"


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect.

    `inputs` are attribute names in network order. A `per_channel` effect mixes no colour
    channels: a network trained on one of them serves all three. `outputs` are the answer's EXR
    channels and `range` the lowest and highest value it may have (None: no bound), which the
    exporter adds to the graph. `transfer` is the curve that networks see light through
    (`deepshade.transfer`).

    `lengths` says what lengths are divided by before a network sees them: the effect's radius, or
    the picture's median depth.

    `background` is the answer where there is no surface: a number; "light", what came in there;
    or "shaded", what the network makes of it (a blurred sky). `trivial` is the answer of doing
    nothing, beside whose error every error is shown: a number; an input, which under an
    environment is multiplied by its mean; another effect, by its reference; or "irradiance", what
    of the environment falls on unblocked surfaces. A view has something to show where `contrast`
    (the reference's standard deviation, or the trivial answer's DSSIM) is at least
    `min_contrast`.

    `settings` name what a user sets (`deepshade.effects.settings`). `symmetries` are the turns and
    mirrors that a view may be learnt in: all 8, but where world-space directions would be
    mirrored against camera-space ones. `history` is how much of a moving picture's answer may be
    that of the frame before; 0 where it gains nothing.
    """

    name: str
    title: str
    inputs: tuple[str, ...]
    reference: str
    outputs: tuple[str, ...] = RGB
    per_channel: bool = False
    range: tuple[float | None, float | None] = (0.0, None)
    transfer: Literal["linear", "log"] = "log"
    lengths: Literal["radius", "depth"] = "depth"
    background: float | Literal["light", "shaded"] = "shaded"
    trivial: float | str = 0.0
    contrast: Literal["deviation", "dssim"] = "dssim"
    min_contrast: float = 0.02
    settings: tuple[str, ...] = ()
    symmetries: tuple[int, ...] = ALL
    history: float = 0.0

    def __post_init__(self) -> None:
        for name in self.inputs:
            if name not in ATTRIBUTES:
                raise ValueError(f"{self.name}: no attribute is called '{name}'")

    def takes(self, setting: Setting) -> bool:
        """Whether a user sets it of this effect: `settings` name it, or what it belongs to."""
        return (setting.of or setting.name) in self.settings

    @property
    def is_light(self) -> bool:
        """Whether the answer is radiance: exposed before it is compared or shown."""
        return self.range[1] is None

    @property
    def trivial_layer(self) -> str | None:
        """What samples hold the trivial answer as; None where it takes no layer of theirs."""
        if not isinstance(self.trivial, str) or self.trivial == IRRADIANCE:
            return None
        return self.trivial if self.trivial in ATTRIBUTES else f"reference_{self.trivial}"

    @property
    def storage(self) -> str:
        """The narrowest type that holds the answer in a shard."""
        return "float32" if self.is_light else "float16"
