"""The networks: the paper's and ours, each made from a small config of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError, DataError
from deepshade_trainer.networks.carrier import Carrier, CarrierConfig
from deepshade_trainer.networks.chain import Chain, ChainConfig
from deepshade_trainer.networks.discs import Discs, DiscsConfig
from deepshade_trainer.networks.fold_unet import FoldConfig, FoldUNet
from deepshade_trainer.networks.lens import Lens, LensConfig
from deepshade_trainer.networks.network import Network
from deepshade_trainer.networks.openings import Openings, OpeningsConfig
from deepshade_trainer.networks.paper_unet import PaperConfig, PaperUNet
from deepshade_trainer.networks.perceptron import Perceptron, PerceptronConfig
from deepshade_trainer.networks.reflections import Reflections, ReflectionsConfig
from deepshade_trainer.networks.shader import Shader

__all__ = [
    "FoldConfig",
    "Network",
    "NetworkConfig",
    "Shader",
    "build",
    "bundle_weights",
    "check_learns",
    "from_bundle",
    "inputs_of",
    "network_config",
]

NetworkConfig = (
    CarrierConfig
    | ChainConfig
    | DiscsConfig
    | FoldConfig
    | LensConfig
    | OpeningsConfig
    | PaperConfig
    | PerceptronConfig
    | ReflectionsConfig
)

_KINDS: dict[str, tuple[Any, Any]] = {
    "carrier": (CarrierConfig, Carrier),
    "chain": (ChainConfig, Chain),
    "discs": (DiscsConfig, Discs),
    "fold": (FoldConfig, FoldUNet),
    "lens": (LensConfig, Lens),
    "openings": (OpeningsConfig, Openings),
    "paper": (PaperConfig, PaperUNet),
    "perceptron": (PerceptronConfig, Perceptron),
    "reflections": (ReflectionsConfig, Reflections),
}


def build(config: NetworkConfig) -> Network:
    """The network that `config` describes, with random weights.

    Raises ConfigError where its entries don't fit each other.
    """
    made: Network = _KINDS[config.kind][1](config)
    return made


def check_learns(effect: str, kind: str | None) -> None:
    """Raise ConfigError for a kind of network of which nothing is learnt."""
    if kind in _KINDS and _KINDS[kind][1].calculated:
        raise ConfigError(
            effect,
            detail=f"the shader of '{effect}' that ships is calculated: it has nothing to learn",
            fix="use it as it is, train the paper's network instead (deepshade train "
            f"{effect} --preset paper), or choose another effect",
        )


def network_config(settings: Mapping[str, Any], base: NetworkConfig | None = None) -> NetworkConfig:
    """The configuration that `settings` give, which may come from JSON; the rest is `base`'s.

    Of a base of another kind only the inputs and outputs stay. Raises ConfigError for an unknown
    kind or setting, and for values that no network could mean.
    """
    kind = settings.get("kind", base.kind if base else None)
    if kind not in _KINDS:
        detail = f"no network {kind!r}, only {', '.join(_KINDS)}"
        raise ConfigError(str(kind), _KINDS, detail=detail)
    config = _KINDS[kind][0]
    if base is None or base.kind != kind:
        base = config(**({"inputs": base.inputs, "outputs": base.outputs} if base else {}))
    known = {field.name for field in dataclasses.fields(config)}
    for key in settings:
        if key not in known:
            raise ConfigError(key, known)
    values: dict[str, Any] = {
        k: network_config(v, getattr(base, k))
        if isinstance(v, Mapping)
        else tuple(v)
        if isinstance(v, list)
        else v
        for k, v in settings.items()
    }
    return dataclasses.replace(base, **values)


def inputs_of(kind: str) -> tuple[str, ...]:
    """The attributes that networks of a kind see, where they are other than the effect's."""
    found: tuple[str, ...] = _KINDS[kind][1].attributes if kind in _KINDS else ()
    return found


def from_bundle(path: Path | str) -> Shader:
    """A bundle's shader in PyTorch, with its weights, in evaluation mode.

    Raises BundleError or DataError where the bundle or its weights don't fit.
    """
    bundle = Bundle.load(path)
    network = build(network_config(bundle.network))
    weights, own = bundle_weights(bundle), network.state_dict()
    if wrong := [n for n, w in own.items() if n not in weights or weights[n].shape != w.shape]:
        raise DataError(
            f"{bundle.model} lacks the weights {', '.join(wrong)}", fix="export the bundle again"
        )
    network.load_state_dict({name: weights[name] for name in own})
    return Shader(EFFECTS[bundle.effect], network).eval()


def bundle_weights(bundle: Bundle) -> dict[str, Tensor]:
    """A bundle's weights by the names that its network has for them."""
    import onnx
    from onnx import numpy_helper

    own = build(network_config(bundle.network)).state_dict()
    graph = onnx.load(str(bundle.model)).graph
    found: dict[str, Tensor] = {}
    for tensor in graph.initializer:
        if tensor.name in own:
            value = torch.from_numpy(numpy_helper.to_array(tensor).copy())
            # The stem's may have one more input channel, all zeros: see `prepare_export`.
            found[tensor.name] = value[:, : own[tensor.name].shape[1]] if value.ndim > 1 else value
    return found
