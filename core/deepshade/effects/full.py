"""Full shading: image-based light weighted by occlusion, seen through a thin lens."""

from deepshade.effects.effect import Effect
from deepshade.symmetry import ROTATIONS

EFFECT = Effect(
    "full",
    "Full shading",
    ("normal_world", "view", "diffuse", "specular", "gloss", "normal", "position", "focal"),
    "ibl weighted by ao, seen through a thin lens",
    lengths="radius",
    trivial="ibl",
    settings=("radius", "focus", "aperture", "environment"),
    symmetries=ROTATIONS,
)
