"""Anti-aliasing: the mean over a pixel's square."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "aa",
    "Anti-aliasing",
    ("depth", "light"),
    "at least 64 sub-pixel samples, against one centre sample as input",
    per_channel=True,
    trivial="light",
)
