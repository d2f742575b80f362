"""Motion blur: averaged while the shutter is open."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "mb",
    "Motion blur",
    ("motion", "light", "depth"),
    "averaged over the shutter, objects moving parallel to the image plane",
    per_channel=True,
    trivial="light",
    settings=("shutter",),
)
