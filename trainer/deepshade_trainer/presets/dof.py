"""Depth of field."""

from deepshade_trainer.presets.paper import paper

PRESETS = {
    "balanced": {"network": {"kind": "discs"}},
    **paper({"kind": "paper", "u0": 8, "levels": 5}),
}
