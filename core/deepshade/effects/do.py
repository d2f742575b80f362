"""Directional occlusion: the environment's light that reaches a surface within a radius."""

from deepshade.effects.effect import IRRADIANCE, Effect
from deepshade.symmetry import ROTATIONS

EFFECT = Effect(
    "do",
    "Directional occlusion",
    ("normal_world", "normal", "position"),
    "(1/π)∫ V_R L_env cosθ dω; equals ao under a white environment",
    lengths="radius",
    background=1.0,
    trivial=IRRADIANCE,
    settings=("radius", "environment"),
    symmetries=ROTATIONS,
)
