"""The per-pixel attributes (the paper's symbols), their units and canonical EXR channels.

What an attribute is measured in decides how it is stored, scaled and turned: a row names its
unit, and nothing else in the project asks for an attribute by name to do one of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Unit:
    """What numbers mean.

    `storage` is the narrowest type that holds them (half floats end at 65504 and resolve 1/2048).
    `scaled` lengths are divided by the effect's radius or the picture's depth before a network
    sees them. `turns` says whether x and y turn with the picture: vectors of camera space (y up)
    or of the screen (v down).
    """

    name: str
    storage: Literal["float16", "float32"] = "float16"
    scaled: bool = False
    turns: Literal["camera", "screen"] | None = None


LENGTH = Unit("length", "float32", scaled=True)
POINT = Unit("length", "float32", scaled=True, turns="camera")  # a place: lengths with a direction
CAMERA_DIRECTION = Unit("direction, camera", turns="camera")
WORLD_DIRECTION = Unit("direction, world")
OBJECT_DIRECTION = Unit("direction, object")  # of the frame that an object was modelled in
PIXELS = Unit("pixels", "float32")
SCREEN_MOTION = Unit("pixels", "float32", turns="screen")  # u right, v down
RADIANS = Unit("radians")
REFLECTANCE = Unit("reflectance")
EXPONENT = Unit("exponent")
RADIANCE = Unit("radiance", "float32")

_SHADING = (WORLD_DIRECTION, RADIANS, REFLECTANCE, EXPONENT)


@dataclass(frozen=True, slots=True)
class Attribute:
    """One per-pixel attribute; `channels` are its canonical EXR names in memory order.

    `in_background` attributes say something where there is no surface too: the sky's light, the
    direction to the camera, the blur at infinity. All others are 0 there.
    """

    name: str
    symbol: str
    channels: tuple[str, ...]
    unit: Unit
    meaning: str
    in_background: bool = False

    @property
    def goes_on(self) -> bool:
        """Whether past the picture's edge its last pixels are repeated, or there is nothing.

        What light and shading are calculated from goes on, or a blurred edge would be lit by
        nothing, or by the sky; the geometry around a point ends.
        """
        return self.in_background or self.unit in _SHADING

    @property
    def coloured(self) -> bool:
        """Whether its channels are R, G and B: an effect run once a channel sees one of them."""
        return len(self.channels) == 3 and self.channels[0].endswith(".R")


def _xyz(layer: str) -> tuple[str, ...]:
    return tuple(f"{layer}.{axis}" for axis in "XYZ")


def _rgb(layer: str) -> tuple[str, ...]:
    return tuple(f"{layer}.{band}" for band in "RGB")


# Camera space: right-handed, +x right, +y up, looking down -z.
_TABLE = (
    Attribute("position", "P_s", _xyz("position"), POINT, "camera-space position"),
    Attribute("normal", "N_s", _xyz("normal"), CAMERA_DIRECTION, "shading normal, camera space"),
    Attribute("normal_world", "N_w", _xyz("normal_world"), WORLD_DIRECTION, "normal, world space"),
    Attribute("normal_object", "N_o", _xyz("normal_object"), OBJECT_DIRECTION, "object space"),
    Attribute("depth", "D_s", ("Z",), LENGTH, "planar depth, -P_s.z, > 0"),
    Attribute("focal", "D_focal", ("focal.V",), PIXELS, "signed diameter of the blur circle", True),
    Attribute("view", "C_w", _xyz("view"), WORLD_DIRECTION, "unit direction to the camera", True),
    Attribute("view_angle", "C_α", ("view_angle.V",), RADIANS, "angle of C_w and N_w"),  # noqa: RUF001
    Attribute("diffuse", "R_diff", _rgb("diffuse"), REFLECTANCE, "Phong diffuse reflectance"),
    Attribute("specular", "R_spec", _rgb("specular"), REFLECTANCE, "Phong specular reflectance"),
    Attribute("gloss", "R_gloss", ("gloss.V",), EXPONENT, "Phong exponent"),
    Attribute("scatter", "R_scatt", _rgb("scatter"), LENGTH, "scattering mean free path"),
    Attribute("light", "L", _rgb("light"), RADIANCE, "direct light to the eye; the sky's", True),
    Attribute("light_diffuse", "L_diff", _rgb("light_diffuse"), RADIANCE, "diffuse part of L"),
    Attribute("motion", "F", ("motion.U", "motion.V"), SCREEN_MOTION, "motion in the open shutter"),
)

ATTRIBUTES: dict[str, Attribute] = {attribute.name: attribute for attribute in _TABLE}
