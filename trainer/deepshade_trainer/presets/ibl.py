"""Image-based lighting."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {},
    "paper": {
        **PAPER,
        "network": {"kind": "chain", "widths": (300,), "kernel": 1, "groups": 3},
        "batch": 5,
    },
}
