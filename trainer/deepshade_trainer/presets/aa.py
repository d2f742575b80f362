"""Anti-aliasing."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {},
    "paper": {**PAPER, "network": {"kind": "chain", "widths": (16,), "kernel": 5}},
}
