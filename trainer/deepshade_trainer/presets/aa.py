"""Anti-aliasing."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {
        "network": {
            "kind": "carrier",
            "bases": "neighbours",
            "fold": 2,
            "widths": (16, 32),
            "steps": (4,),
            "down": (1, 2),
            "up": (1,),
        }
    },
    "paper": {**PAPER, "network": {"kind": "chain", "widths": (16,), "kernel": 5}},
}
