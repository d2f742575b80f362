"""Motion blur."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {
        "network": {
            "kind": "carrier",
            "bases": "lines",
            "widths": (32, 48, 64),
            "steps": (2, 2),
            "up": (1, 1),
        }
    },
    **paper({"kind": "paper", "u0": 16, "levels": 5}),
}
