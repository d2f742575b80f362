"""Image-based lighting: what ships looks its answer up instead (`deepshade_trainer.lookups`)."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {},
    **paper({"kind": "chain", "widths": (300,), "kernel": 1, "groups": 3}, batch=5),
}
