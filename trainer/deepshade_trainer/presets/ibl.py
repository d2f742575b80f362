"""Image-based lighting."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {"network": {"kind": "reflections"}},
    **paper({"kind": "chain", "widths": (300,), "kernel": 1, "groups": 3}, batch=5),
}
