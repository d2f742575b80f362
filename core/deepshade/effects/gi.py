"""Indirect light: one bounce of the direct light around, within a radius."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "gi",
    "Indirect light",
    ("normal", "position", "light_diffuse"),
    "(1/π)∫ over hits within R of their L_diff · cosθ dω, one bounce",
    per_channel=True,
    lengths="radius",
    background=0.0,
    settings=("radius",),
)
