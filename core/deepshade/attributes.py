"""The per-pixel attributes (the paper's symbols) and their canonical EXR channels, as one table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Space = Literal["camera", "world", "none"]
Kind = Literal["point", "vector", "scalar", "colour", "motion"]


@dataclass(frozen=True, slots=True)
class Attribute:
    """One per-pixel attribute; `channels` are its canonical EXR names in memory order."""

    name: str
    symbol: str
    channels: tuple[str, ...]
    space: Space
    kind: Kind
    meaning: str


def _xyz(layer: str) -> tuple[str, ...]:
    return tuple(f"{layer}.{axis}" for axis in "XYZ")


def _rgb(layer: str) -> tuple[str, ...]:
    return tuple(f"{layer}.{band}" for band in "RGB")


# Camera space: right-handed, +x right, +y up, looking down -z. Lengths in scene units.
_TABLE = (
    Attribute("position", "P_s", _xyz("position"), "camera", "point", "camera-space position"),
    Attribute("normal", "N_s", _xyz("normal"), "camera", "vector", "shading normal, camera space"),
    Attribute(
        "normal_world",
        "N_w",
        _xyz("normal_world"),
        "world",
        "vector",
        "normal, world space",
    ),
    Attribute("depth", "D_s", ("Z",), "none", "scalar", "planar depth, -P_s.z, > 0"),
    Attribute(
        "focal",
        "D_focal",
        ("focal.V",),
        "none",
        "scalar",
        "signed blur diameter, pixels",
    ),
    Attribute("view", "C_w", _xyz("view"), "world", "vector", "unit direction to the camera"),
    Attribute(
        "view_angle",
        "C_α",  # noqa: RUF001 - the paper's symbol
        ("view_angle.V",),
        "none",
        "scalar",
        "angle of C_w and N_w, radians",
    ),
    Attribute("diffuse", "R_diff", _rgb("diffuse"), "none", "colour", "Phong diffuse reflectance"),
    Attribute(
        "specular", "R_spec", _rgb("specular"), "none", "colour", "Phong specular reflectance"
    ),
    Attribute("gloss", "R_gloss", ("gloss.V",), "none", "scalar", "Phong exponent"),
    Attribute(
        "scatter", "R_scatt", _rgb("scatter"), "none", "colour", "mean free path, scene units"
    ),
    Attribute("light", "L", _rgb("light"), "none", "colour", "direct light"),
    Attribute(
        "light_diffuse", "L_diff", _rgb("light_diffuse"), "none", "colour", "diffuse direct light"
    ),
    Attribute(
        "motion",
        "F",
        ("motion.U", "motion.V"),
        "none",
        "motion",
        "motion during the exposure, pixels, u right, v down",
    ),
)

ATTRIBUTES: dict[str, Attribute] = {attribute.name: attribute for attribute in _TABLE}
