"""Anti-aliasing: the mean over a pixel's square."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "aa",
    "Anti-aliasing",
    ("depth", "light"),
    "at least 64 sub-pixel samples, against one centre sample as input",
    per_channel=True,
    trivial="light",
    min_contrast=0.005,  # edges are few pixels: of real views at 512 x 512 none has .02
)
