"""Anti-aliasing."""

from deepshade_trainer.presets.paper import paper

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
    **paper({"kind": "chain", "widths": (16,), "kernel": 5}),
}
