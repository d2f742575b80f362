"""Depth of field: a thin lens with an aperture."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "dof",
    "Depth of field",
    ("focal", "light"),
    "thin lens, averaged over the aperture",
    per_channel=True,
    trivial="light",
    settings=("focus", "aperture"),
)
