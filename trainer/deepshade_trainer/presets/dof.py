"""Depth of field."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {
        "network": {
            "kind": "carrier",
            "bases": "discs",
            "widths": (24, 32, 48),
            "steps": (2, 2),
            "up": (1, 1),
        }
    },
    **paper({"kind": "paper", "u0": 8, "levels": 5}),
}
