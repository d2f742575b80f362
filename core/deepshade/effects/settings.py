"""What a user sets of an effect, by the name that requests, commands and headers use."""

from __future__ import annotations

from dataclasses import dataclass

# Far beyond any scene, and safely inside what float32 can divide by.
MIN_LENGTH, MAX_LENGTH = 1e-30, 1e30


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting: its unit, the lowest and highest value, and what it means.

    An image's header holds it as `deepshade:<name>`.
    """

    name: str
    unit: str
    lowest: float
    highest: float
    meaning: str

    @property
    def header(self) -> str:
        """The EXR attribute that holds it."""
        return f"deepshade:{self.name}"


_TABLE = (
    Setting("radius", "scene units", MIN_LENGTH, MAX_LENGTH, "how far the effect reaches"),
    Setting("focus", "scene units", MIN_LENGTH, MAX_LENGTH, "distance of the plane in focus"),
    Setting("aperture", "scene units", 0.0, MAX_LENGTH, "diameter of the lens"),
    Setting("shutter", "frames", 0.0, 1.0, "how long the shutter is open"),
    Setting("environment", "name", 0.0, 0.0, "the environment map that lights the scene"),
)

SETTINGS: dict[str, Setting] = {setting.name: setting for setting in _TABLE}
