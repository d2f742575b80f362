"""Depth of field."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {},
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 8, "levels": 5}},
}
