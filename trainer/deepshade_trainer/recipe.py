"""How a shader is trained: one dataclass of settings, and presets that hold what differs."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError
from deepshade.files import replacing
from deepshade_trainer.losses import parse_loss
from deepshade_trainer.networks import KINDS, NetworkConfig

CHOICES = {
    "effect": tuple(EFFECTS),
    "optimizer": ("adamw", "adadelta"),
    "schedule": ("cosine", "constant"),
    "precision": ("bf16", "fp32"),
}


def check_types(settings: Any) -> None:
    """Raise ConfigError for a field of a settings dataclass that isn't of its default's type."""
    for field_ in dataclasses.fields(settings):
        default, value = field_.default, getattr(settings, field_.name)
        if default is dataclasses.MISSING or (value is None and "None" in str(field_.type)):
            continue
        wanted = (int, float) if isinstance(default, float) else type(default)
        good = isinstance(value, wanted) and not isinstance(value, bool)
        if isinstance(value, tuple):
            good = good and all(type(v) is int and v >= 0 for v in value)
        if not good:
            raise ConfigError(
                field_.name, detail=f"{field_.name} can't be {value!r}, it is like {default!r}"
            )


@dataclass(frozen=True)
class Recipe:
    """Settings of a run; the defaults are ours.

    `optimizer` is "adamw" or "adadelta"; `schedule` "cosine" (after `warmup` steps) or
    "constant"; `precision` "bf16" or "fp32"; `ema` the weight average's decay a step (0: none);
    `clip` bounds the gradient's norm (0: none). `start` is the folder of a run whose averaged
    weights to begin with, where names and shapes agree ("": at random).
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
    steps: int = 7500
    seed: int = 0
    held_out: float = 0.04
    start: str = ""

    def __post_init__(self) -> None:
        """Raise ConfigError for a value that no run could mean."""
        check_types(self)
        for key, choices in CHOICES.items():
            if getattr(self, key) not in choices:
                raise ConfigError(
                    str(getattr(self, key)),
                    choices,
                    detail=f"{key} must be one of {', '.join(choices)}, not {getattr(self, key)!r}",
                )
        parse_loss(self.loss)
        for key in ("batch", "steps"):
            if getattr(self, key) < 1:
                raise ConfigError(key, detail=f"{key} must be at least 1, not {getattr(self, key)}")
        if not 0 <= self.held_out < 1:
            raise ConfigError("held_out", detail=f"held_out must be in [0, 1), not {self.held_out}")

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
            check_types(changes["network"])
            if changes["network"].kind not in KINDS:
                raise ConfigError(
                    str(changes["network"].kind),
                    KINDS,
                    detail=f"no network {changes['network'].kind!r}: {', '.join(KINDS)}",
                )
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

# The defaults are those of the bundles called "balanced"; these are its two neighbours.
FAST: dict[str, Any] = {
    "network": {
        "widths": (32, 64, 64),
        "steps": (4, 2),
        "down": (0, 2, 2),
        "up": (1, 2),
        "rings": (1, 1, 2, 2),
        "fine_rings": (1, 2, 4),
        "detail": (),
    }
}
BEST: dict[str, Any] = {
    "network": {
        "widths": (64, 96, 128, 160),
        "steps": (2, 2, 2),
        "down": (1, 2, 3, 3),
        "up": (2, 2, 3),
        "fine_rings": (1, 1, 2, 2, 4, 4, 8, 8),
    }
}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "fast": FAST,
    "balanced": {},
    "best": BEST,
    "paper": PAPER,
    "paper-network": PAPER_NETWORK,
}


def preset(name: str, effect: str) -> Recipe:
    """The recipe of a preset for an effect; raises ConfigError if either is unknown."""
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect {effect!r}: {', '.join(EFFECTS)}")
    if name not in PRESETS:
        raise ConfigError(name, PRESETS, detail=f"no preset {name!r}: {', '.join(PRESETS)}")
    return Recipe(effect, NetworkConfig(**channels_of(effect))).changed(**PRESETS[name])


def channels_of(effect: str) -> dict[str, Any]:
    """A network's inputs and outputs for `effect`, and where normals and positions lie in it.

    Effects "per channel" run once for each colour channel, so a colour counts as one.
    """
    row = EFFECTS[effect]
    found: dict[str, Any] = {"normal": None, "position": None}
    start = 0
    for name in row.inputs:
        if name in found:
            found[name] = start
        attribute = ATTRIBUTES[name]
        one = row.per_channel and attribute.kind == "colour"
        start += 1 if one else len(attribute.channels)
    return {**found, "inputs": start, "outputs": 1 if row.per_channel else len(row.outputs)}
