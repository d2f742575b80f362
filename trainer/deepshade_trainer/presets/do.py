"""Directional occlusion."""

from deepshade.bundles import bundle_root
from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {
        "network": {"kind": "openings"},
        "batch": 2,
        "steps": 6000,
        "precision": "fp32",
        # whose trunk stays as it is
        "init_from": str(bundle_root() / "ao" / "balanced"),
    },
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 16, "levels": 5}},
}
