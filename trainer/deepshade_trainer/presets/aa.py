"""Anti-aliasing."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {
        "network": {
            "kind": "carrier",
            "bases": "neighbours",
            "widths": (24, 48),
            "steps": (4,),
            "down": (1, 2),
            "up": (1,),
        }
    },
    "paper": {**PAPER, "network": {"kind": "chain", "widths": (16,), "kernel": 5}},
}
