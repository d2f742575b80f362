"""Indirect light."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {
        "network": {
            "kind": "carrier",
            "bases": "bounces",
            "widths": (32, 64, 96),
            "normal": 0,
            "position": 3,
        }
    },
    **paper({"kind": "paper", "u0": 16, "levels": 5}, batch=45),
}
