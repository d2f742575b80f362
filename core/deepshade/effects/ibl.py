"""Image-based lighting: an environment reflected by an unblocked Phong surface."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "ibl",
    "Image-based lighting",
    ("normal_world", "view", "diffuse", "specular", "gloss"),
    "∫ f_Phong L_env cosθ dω, unblocked; normalised Phong",
    trivial="diffuse",
    settings=("environment",),
)
