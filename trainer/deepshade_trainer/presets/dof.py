"""Depth of field."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {"network": {"kind": "carrier", "bases": "discs"}},
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 8, "levels": 5}},
}
