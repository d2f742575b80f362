"""Indirect light."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {},
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 16, "levels": 5}, "batch": 45},
}
