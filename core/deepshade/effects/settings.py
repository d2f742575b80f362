"""What a user sets of an effect, by the name that requests, commands and headers use."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

# Far beyond any scene, and safely inside what float32 can divide by.
MIN_LENGTH, MAX_LENGTH = 1e-30, 1e30
MAX_TURN = 36000.0


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting: its unit, what it means, the lowest and highest value, and the default.

    A name has neither lowest nor highest. Where `stored`, an image's header holds it as
    `deepshade:<name>`, which comes before the default; None is none. The default of a length may be
    a `share` of the picture's median depth; shaders learnt it at shares in `learnt`.
    An effect that has the setting `of` has this one too.
    """

    name: str
    unit: str
    meaning: str
    lowest: float | None = None
    highest: float | None = None
    default: float | str | None = None
    stored: bool = True
    of: str = ""
    share: float = 0.0
    learnt: tuple[float, float] = (0.0, inf)

    @property
    def header(self) -> str:
        """The EXR attribute that holds it."""
        return f"deepshade:{self.name}"


_TABLE = (
    Setting(
        "radius",
        "scene units",
        "how far the effect reaches",
        MIN_LENGTH,
        MAX_LENGTH,
        default="15% of the median depth",
        # the middle of what is learnt, where radii are drawn log-uniformly: √(.05 · .5) = .158
        share=0.15,
        learnt=(0.05, 0.5),
    ),
    Setting("focus", "scene units", "distance of the plane in focus", MIN_LENGTH, MAX_LENGTH),
    Setting("aperture", "scene units", "diameter of the lens", 0.0, MAX_LENGTH),
    Setting("shutter", "frames", "how long the shutter is open", 0.0, 1.0),
    Setting(
        "environment",
        "name",
        "the environment map that lights the scene",
        default="sky",
        stored=False,
    ),
    Setting(
        "rotate",
        "degrees",
        "how far the map is turned about the world's up axis, counter-clockwise from above",
        -MAX_TURN,
        MAX_TURN,
        default=0.0,
        stored=False,
        of="environment",
    ),
    Setting(
        "up",
        "y or z",
        "the world's up axis, if it isn't the renderer's",
        default="y",
        stored=False,
        of="environment",
    ),
)

SETTINGS: dict[str, Setting] = {setting.name: setting for setting in _TABLE}
