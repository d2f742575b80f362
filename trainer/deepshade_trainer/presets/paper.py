"""How the paper trains (section 4.3), apart from the network and the number of steps."""

from typing import Any

PAPER: dict[str, Any] = {
    "loss": "dssim",
    "optimizer": "adadelta",
    "lr": 1.0,
    "weight_decay": 0.0,
    "schedule": "constant",
    "warmup": 0,
    "clip": 0.0,
    "ema": 0.0,
    "precision": "fp32",
    "batch": 16,
}
