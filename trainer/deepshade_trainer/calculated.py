"""Writes bundles whose shaders are calculated: nothing of them is trained."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import DataError
from deepshade.tensors import up
from deepshade_trainer.export import write_bundle
from deepshade_trainer.networks import NetworkConfig, Shader, build, bundle_weights, network_config

_SIDE = 96  # of the picture that parity is proven on


def calculated(
    effect: str, kind: str, of: Bundle | None = None, **settings: Any
) -> tuple[NetworkConfig, Shader]:
    """A calculated network's configuration, and the effect's shader in evaluation mode.

    `kind` and `settings` are as in `networks.network_config`. The weights of a part of it are
    those `of` a trained bundle of occlusion. Raises DataError for a bundle of another kind.
    """
    if of is None:
        config = network_config({"kind": kind, **settings})
        return config, Shader(EFFECTS[effect], build(config)).eval()
    if of.network.get("kind") != "fold":
        raise DataError(f"{of.path} is no part of a {kind!r}")
    part = _part(kind)
    config = network_config({"kind": kind, part: of.network, "of": of.short_hash, **settings})
    network = build(config)
    network.get_submodule(part).load_state_dict(bundle_weights(of))
    return config, Shader(EFFECTS[effect], network).eval()


def export_calculated(
    folder: Path, kind: str, of: Bundle | None = None, **settings: Any
) -> tuple[Bundle, float]:
    """The bundle `folder` (its last two names are effect and name), and its parity: how far ONNX
    Runtime strays from torch.

    The rest as in `calculated`; what of the bundle `of` may be calculated in 8 bits is taken over.
    Raises DataError: too far.
    """
    config, shader = calculated(folder.parent.name, kind, of, **settings)
    int8 = {f"{_part(kind)}.{name}": span for name, span in of.int8.items()} if of else {}
    side = up(_SIDE, shader.size_multiple)
    return write_bundle(
        shader,
        config,
        folder,
        [torch.from_numpy(picture(side, shader.effect.inputs))],
        ranges=of.ranges if of else {},
        int8=lambda _: int8,
    )


@cache
def _part(kind: str) -> str:
    """What of such a network is another's: only that may be rounded."""
    return (build(network_config({"kind": kind})).rounded or "").removesuffix(".")


def picture(side: int, inputs: Sequence[str]) -> NDArray[np.float32]:
    """(1, C, side, side) of these attributes: a ball before nothing, glossier to the right.

    It is a unit across, and its lower half is out of focus.
    """
    at = (np.arange(side) + 0.5) / side * 2.2 - 1.1
    x, y = np.broadcast_to(at, (side, side)), -np.broadcast_to(at[:, None], (side, side))
    square = x * x + y * y
    ball = square < 1
    z = np.sqrt(np.where(ball, 1 - square, 0))
    view = np.stack([-0.2 * x, -0.2 * y, np.ones_like(x)])
    known = {
        "normal_world": np.stack([x, y, z]) * ball,
        "normal": np.stack([x, y, z]) * ball,
        "view": view / np.linalg.norm(view, axis=0),
        "diffuse": np.broadcast_to(0.5 * ball, (3, side, side)),
        "specular": np.broadcast_to(0.5 * ball, (3, side, side)),
        "gloss": (10 ** np.clip(2 + 2 * x, 0, 4) * ball)[None],
        "position": np.stack([x, y, z - 4]) / 2 * ball,
        "focal": (20 * np.clip(-y, 0, 1))[None],
        "light": np.stack([1 + x, 1 + y, 1.5 - z]),
    }
    return np.concatenate([known[name] for name in inputs])[None].astype(np.float32)
