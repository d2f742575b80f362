"""How the paper trains (section 4.3), apart from the number of steps, and what it trains."""

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


def paper(network: dict[str, Any], **settings: Any) -> dict[str, dict[str, Any]]:
    """Presets of the paper's `network`: trained as in the paper, but for `settings`, and our way.

    The second shows what its shape costs, apart from its recipe.
    """
    return {
        "paper": {**PAPER, "network": network, **settings},
        "paper-network": {"network": network},
    }
