"""Writes rendered samples as memory-mappable shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.files import replacing
from deepshade.manifest import Shard

Images = dict[str, NDArray[np.float32]]

# Absolute positions and depths need more than fp16's 11 bits; everything else fits.
WIDE = {"position", "depth"}


def dtype_of(tensor: str) -> type[np.floating[Any]]:
    """float32 for lengths in scene units, float16 for what is bounded."""
    return np.float32 if tensor in WIDE else np.float16


def schema(effects: Sequence[str], size: int) -> dict[str, dict[str, Any]]:
    """Tensors of a data set for `effects`: their inputs, references and errors."""
    tensors: dict[str, dict[str, Any]] = {}
    for effect in effects:
        for name in EFFECTS[effect].inputs:
            tensors[name] = _entry(name, len(ATTRIBUTES[name].channels), size)
        for name in (f"reference_{effect}", f"reference_{effect}_error"):
            tensors[name] = _entry(name, len(EFFECTS[effect].outputs), size)
    return tensors


def _entry(name: str, channels: int, size: int) -> dict[str, Any]:
    return {"dtype": np.dtype(dtype_of(name)).name, "shape": [channels, size, size]}


def shard_name(index: int) -> str:
    """File name of shard `index`."""
    return f"shard-{index:05d}.safetensors"


def write_shard(
    folder: Path,
    index: int,
    tensors: Sequence[str],
    images: Sequence[Images],
    records: list[dict[str, Any]],
) -> Shard:
    """Write shard `index` from planar (C, H, W) `images`; the same input gives the same bytes."""
    from safetensors.numpy import save

    stacked = {
        name: np.stack([sample[name] for sample in images]).astype(dtype_of(name))
        for name in sorted(tensors)
    }
    content = save(stacked, metadata={"samples": json.dumps(records, sort_keys=True)})
    name = shard_name(index)
    with replacing(folder / name) as temporary:
        temporary.write_bytes(content)
    return Shard(name, hashlib.sha256(content).hexdigest(), records)
