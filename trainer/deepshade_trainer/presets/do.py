"""Directional occlusion."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {"network": {"kind": "openings"}},
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 16, "levels": 5}},
}
