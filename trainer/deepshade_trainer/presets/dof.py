"""Depth of field."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {
        "network": {"kind": "carrier", "bases": "discs", "widths": (24, 48, 64), "up": (1, 2)}
    },
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 8, "levels": 5}},
}
