"""Full shading."""

from deepshade_trainer.presets.paper import PAPER

PRESETS = {
    "balanced": {"network": {"kind": "lens"}},
    # 136,371 parameters; 5 levels have 302,835. The paper says 203 K, which its rule never gives.
    "paper": {**PAPER, "network": {"kind": "paper", "u0": 24, "levels": 4}},
}
