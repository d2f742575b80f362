"""Subsurface scattering."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {"network": {"kind": "carrier", "bases": "diffusion", "widths": (32, 64, 96)}},
    **paper({"kind": "paper", "u0": 16, "levels": 5}),
}
