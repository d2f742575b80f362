"""Ambient occlusion: the share of the hemisphere that nothing blocks within a radius."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "ao",
    "Ambient occlusion",
    ("normal", "position"),
    "(1/π)∫ V_R cosθ dω; 1 = open",
    outputs=("Y",),
    range=(0.0, 1.0),
    transfer="linear",
    lengths="radius",
    background=1.0,
    trivial=1.0,
    contrast="deviation",
    min_contrast=0.12,
    settings=("radius",),
    history=0.8,
)
