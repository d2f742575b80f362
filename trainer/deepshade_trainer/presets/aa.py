"""Anti-aliasing."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {"network": {"kind": "carrier", "bases": "neighbours"}},
    "paper": {**PAPER, "network": {"kind": "chain", "widths": (16,), "kernel": 5}},
}
