"""How a shader is trained: one dataclass of settings, and presets that hold what differs."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError
from deepshade.files import replacing

from .networks import NetworkConfig


@dataclass(frozen=True)
class Recipe:
    """Settings of a run; the defaults are ours.

    `optimizer` is "adamw" or "adadelta"; `schedule` "cosine" (after `warmup` steps) or
    "constant"; `precision` "bf16" or "fp32"; `ema` the weight average's decay a step (0: none);
    `clip` bounds the gradient's norm (0: none).
    """

    effect: str = "ao"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: str = "dssim + 0.5 l1"
    optimizer: str = "adamw"
    rate: float = 2e-3
    decay: float = 1e-4
    schedule: str = "cosine"
    warmup: int = 200
    clip: float = 1.0
    ema: float = 0.998
    precision: str = "bf16"
    batch: int = 8
    steps: int = 12000
    seed: int = 0
    held_out: float = 0.04

    def changed(self, **changes: Any) -> Recipe:
        """A copy with some settings replaced; `network` takes a dict of its own.

        Raises:
            ConfigError: there is no such setting.
        """
        known = {field.name for field in dataclasses.fields(self)}
        for key in changes:
            if key not in known:
                raise ConfigError(key, known)
        if isinstance(network := changes.get("network"), dict):
            inner = {field.name for field in dataclasses.fields(NetworkConfig)}
            for key in network:
                if key not in inner:
                    raise ConfigError(key, inner)
            lists: dict[str, Any] = {
                k: tuple(v) if isinstance(v, list) else v for k, v in network.items()
            }
            changes["network"] = dataclasses.replace(self.network, **lists)
        return dataclasses.replace(self, **changes)

    def write(self, path: Path) -> None:
        """Save as JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(asdict(self), indent=1))

    @classmethod
    def read(cls, path: Path) -> Recipe:
        """Load what `write` saved; raises ConfigError for unknown settings."""
        return cls().changed(**json.loads(path.read_text()))


# The paper's network and optimizer (section 4.3): what differs from the defaults.
PAPER: dict[str, Any] = {
    "network": {"kind": "paper", "widths": (8, 16, 32, 64, 128, 256)},
    "loss": "dssim",
    "optimizer": "adadelta",
    "rate": 1.0,
    "decay": 0.0,
    "schedule": "constant",
    "warmup": 0,
    "clip": 0.0,
    "ema": 0.0,
    "precision": "fp32",
    "batch": 16,
}
# The paper's network, trained our way: what its shape costs, apart from its recipe.
PAPER_NETWORK: dict[str, Any] = {"network": PAPER["network"]}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": PAPER,
    "paper-network": PAPER_NETWORK,
}


def preset(name: str, effect: str) -> Recipe:
    """The recipe of a preset for an effect; raises ConfigError if either is unknown."""
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect {effect!r}: {', '.join(EFFECTS)}")
    if name not in PRESETS:
        raise ConfigError(name, PRESETS, detail=f"no preset {name!r}: {', '.join(PRESETS)}")
    return Recipe(effect=effect).changed(**PRESETS[name])
