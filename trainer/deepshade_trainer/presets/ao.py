"""Ambient occlusion."""

from deepshade_trainer.presets.paper import paper

_BIAS = 0.85  # the mean of an occlusion image, or so

PRESETS = {
    "fast": {
        "network": {
            "widths": (32, 64, 64),
            "steps": (4, 2),
            "down": (0, 2, 2),
            "up": (1, 2),
            "rings": (1, 1, 2, 2),
            "fine_rings": (1, 2, 4),
            "detail": (),
            "bias": _BIAS,
        }
    },
    "balanced": {"network": {"down": (1, 1, 2), "up": (1, 1), "fine": 16, "bias": _BIAS}},
    "best": {"network": {"fine": 48, "bias": _BIAS}},
    **{
        f"mlp-{a}x{b}": {
            "network": {"kind": "perceptron", "widths": (a, b)},
            "loss": "l2",
            "optimizer": "lbfgs",
            "steps": 80,  # of ten iterations each
        }
        for a, b in ((16, 8), (32, 16), (64, 32))
    },
    **paper({"kind": "paper", "u0": 8, "levels": 6}),
}
