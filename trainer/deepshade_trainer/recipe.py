"""How a shader is trained: one dataclass of settings, and where presets come from."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from deepshade.effects import EFFECTS, Effect
from deepshade.errors import ConfigError
from deepshade.files import replacing
from deepshade.tensors import channel_count, channel_slices
from deepshade_trainer.losses import parse_loss
from deepshade_trainer.networks import (
    FoldConfig,
    NetworkConfig,
    check_learns,
    inputs_of,
    network_config,
)
from deepshade_trainer.networks.network import check_types

CHOICES = {
    "effect": tuple(EFFECTS),
    "optimizer": ("adamw", "adadelta", "lbfgs"),
    "schedule": ("cosine", "constant"),
    "precision": ("bf16", "fp32"),
}


@dataclass(frozen=True)
class Recipe:
    """Settings of a run; the defaults are ours.

    `optimizer` is "adamw", "adadelta" or, for perceptrons, "lbfgs"; `schedule` "cosine" (after
    `warmup` steps) or "constant"; `precision` "bf16" or "fp32"; `ema` the weight average's
    decay a step (0: none); `clip` bounds the gradient's norm (0: none). `val_fraction` of the
    scenes are validated on and not trained on. `steady` weighs how far an answer's values
    change where the picture is moved by some pixels (0: not looked at, and half the work).
    `init_from` is the folder of a run, whose averaged weights to begin with, or of a bundle;
    where names and shapes agree ("": at random).
    """

    effect: str = "ao"
    network: NetworkConfig = field(default_factory=FoldConfig)
    loss: str = "dssim + 0.5 l1"
    steady: float = 0.0
    optimizer: str = "adamw"
    lr: float = 2e-3
    weight_decay: float = 1e-4
    schedule: str = "cosine"
    warmup: int = 200
    clip: float = 1.0
    ema: float = 0.998
    precision: str = "bf16"
    batch: int = 8
    steps: int = 7500
    seed: int = 0
    val_fraction: float = 0.04
    init_from: str = ""

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
        check_learns(self.effect, self.network.kind)
        parse_loss(self.loss)
        for key in ("batch", "steps"):
            if getattr(self, key) < 1:
                raise ConfigError(key, detail=f"{key} must be at least 1, not {getattr(self, key)}")
        if not 0 <= self.val_fraction < 1:
            raise ConfigError(
                "val_fraction", detail=f"val_fraction must be in [0, 1), not {self.val_fraction}"
            )

    @property
    def schedule_is_cut(self) -> bool:
        """Whether the run ends before its rate has warmed up."""
        return self.warmup > self.steps

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
            changes["network"] = network_config(network, self.network)
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


def preset(name: str, effect: str, network: Mapping[str, Any] | None = None) -> Recipe:
    """The recipe of a preset for an effect, from `deepshade_trainer.presets.<effect>`.

    `network` stands in the place of the preset's own, if given.

    Raises ConfigError if either is unknown, or the preset's network is calculated.
    """
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect {effect!r}: {', '.join(EFFECTS)}")
    module = f"deepshade_trainer.presets.{effect}"
    if find_spec(module) is None:
        raise ConfigError(effect, detail=f"'{effect}' has no presets: they belong into {module}")
    presets: dict[str, dict[str, Any]] = import_module(module).PRESETS
    if name not in presets:
        raise ConfigError(name, presets, detail=f"no preset {name!r}: {', '.join(presets)}")
    settings = dict(presets[name])
    own = settings.pop("network", {})
    network = dict(network or own)
    recipe = Recipe(effect, network_config(_channels(EFFECTS[effect], network.get("kind", "fold"))))
    return recipe.changed(network=network, **settings)


def _channels(effect: Effect, kind: str) -> dict[str, Any]:
    """What a network of an effect takes and gives, and where ours finds normals and positions.

    Only positions in effect radii have horizons.
    """
    per_channel = effect.per_channel and kind != "carrier"
    inputs = inputs_of(kind) or effect.inputs
    found: dict[str, Any] = {
        "kind": kind,
        "inputs": channel_count(inputs, per_channel),
        "outputs": 1 if per_channel else len(effect.outputs),
    }
    places = channel_slices(inputs, per_channel)
    geometric = effect.lengths == "radius" and {"normal", "position"} <= places.keys()
    if kind == "fold" and geometric:
        found |= {name: places[name].start for name in ("normal", "position")}
    return found
