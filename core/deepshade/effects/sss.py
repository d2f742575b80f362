"""Subsurface scattering: light that diffuses through a surface before it leaves."""

from deepshade.effects.effect import Effect

EFFECT = Effect(
    "sss",
    "Subsurface scattering",
    ("position", "scatter", "light"),
    "Christensen-Burley normalised diffusion of L over the visible surface",
    per_channel=True,
    background="light",
    trivial="light",
)
