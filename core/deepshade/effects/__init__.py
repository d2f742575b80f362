"""The effects: what each needs and gives. Adding an effect is adding a row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from deepshade.attributes import ATTRIBUTES
from deepshade.relevance import Rule, no_occluder


@dataclass(frozen=True, slots=True)
class Effect:
    """One screen-space effect.

    `inputs` are attribute names in network order. A `per_channel` effect is one network, trained
    on one channel, run on each of its colour channels; `outputs` are the answer's EXR channels.
    `background` is the answer where there is no geometry. `picture` is how 8-bit pictures show it:
    light goes through sRGB's curve, a factor such as occlusion does not. `open_rule` tells the
    pixels whose answer is known without the network (`deepshade.relevance`), None without such.
    """

    name: str
    title: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    per_channel: bool
    background: float
    reference: str
    picture: Literal["linear", "srgb"] = "srgb"
    open_rule: Rule | None = None


_Y = ("Y",)
_RGB = ("R", "G", "B")

_TABLE = (
    Effect(
        "ao",
        "Ambient occlusion",
        ("normal", "position"),
        _Y,
        per_channel=False,
        background=1.0,
        reference="(1/π)∫ V_R cosθ dω; 1 = open",
        picture="linear",
        open_rule=no_occluder,
    ),
    Effect(
        "do",
        "Directional occlusion",
        ("normal_world", "normal", "position"),
        _RGB,
        per_channel=False,
        background=1.0,
        reference="(1/π)∫ V_R L_env cosθ dω; equals ao under a white environment",
    ),
    Effect(
        "ibl",
        "Image-based lighting",
        ("normal_world", "view_angle", "view", "diffuse", "specular", "gloss"),
        _RGB,
        per_channel=False,
        background=0.0,
        reference="∫ f_Phong L_env cosθ dω, unblocked; normalised Phong",
    ),
    Effect(
        "gi",
        "Indirect light",
        ("normal", "position", "light_diffuse"),
        _RGB,
        per_channel=True,
        background=0.0,
        reference="(1/π)∫ over hits within R of their L_diff · cosθ dω, one bounce",
    ),
    Effect(
        "sss",
        "Subsurface scattering",
        ("position", "scatter", "light"),
        _RGB,
        per_channel=True,
        background=0.0,
        reference="Christensen-Burley normalised diffusion of L",
    ),
    Effect(
        "dof",
        "Depth of field",
        ("focal", "light"),
        _RGB,
        per_channel=True,
        background=0.0,
        reference="thin lens, averaged over the aperture",
    ),
    Effect(
        "mb",
        "Motion blur",
        ("motion", "light", "depth"),
        _RGB,
        per_channel=True,
        background=0.0,
        reference="averaged over the shutter, objects moving parallel to the image plane",
    ),
    Effect(
        "aa",
        "Anti-aliasing",
        ("depth", "light"),
        _RGB,
        per_channel=True,
        background=0.0,
        reference="at least 64 sub-pixel samples, against one centre sample as input",
    ),
    Effect(
        "full",
        "Full shading",
        tuple(ATTRIBUTES),
        _RGB,
        per_channel=False,
        background=0.0,
        reference="IBL weighted by AO, seen through a thin lens",
    ),
)

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _TABLE}
