"""Writes rendered samples as memory-mappable shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.attributes import ATTRIBUTES
from deepshade.circles import POINTS
from deepshade.effects import EFFECTS
from deepshade.files import replacing
from deepshade.manifest import Shard
from deepshade_workers.view import Images


def schema(
    effects: Sequence[str], size: int, attributes: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """Tensors of a data set for `effects`: their inputs, references and errors; `attributes`."""
    tensors: dict[str, dict[str, Any]] = {}
    for row in (EFFECTS[effect] for effect in effects):
        for attribute in (ATTRIBUTES[name] for name in (*row.inputs, *attributes)):
            shape = [len(attribute.channels), size, size]
            tensors[attribute.name] = {"dtype": attribute.unit.storage, "shape": shape}
        for name in (f"reference_{row.name}", f"reference_{row.name}_error"):
            tensors[name] = {"dtype": row.storage, "shape": [len(row.outputs), size, size]}
    return tensors


def circle_schema(effects: Sequence[str], pixels: int) -> dict[str, dict[str, Any]]:
    """Tensors of samples that are pixels, each with the normals around it (`circles`)."""
    normal = ATTRIBUTES["normal_object"]
    shape = [len(normal.channels), POINTS, pixels]
    tensors: dict[str, dict[str, Any]] = {
        normal.name: {"dtype": normal.unit.storage, "shape": shape}
    }
    for row in (EFFECTS[effect] for effect in effects):
        for name in (f"reference_{row.name}", f"reference_{row.name}_error"):
            tensors[name] = {"dtype": row.storage, "shape": [len(row.outputs), 1, pixels]}
    return tensors


def shard_name(index: int) -> str:
    """File name of shard `index`."""
    return f"shard-{index:05d}.safetensors"


def write_shard(
    folder: Path,
    index: int,
    tensors: Mapping[str, dict[str, Any]],
    images: Sequence[Images],
    records: list[dict[str, Any]],
) -> Shard:
    """Write shard `index`: of each of `images` the planar (C, H, W) `tensors` of a `schema`.

    The same input gives the same bytes.
    """
    from safetensors.numpy import save

    stacked = {  # in C order, or safetensors would write the numbers in another one
        name: np.stack([sample[name] for sample in images]).astype(tensors[name]["dtype"], "C")
        for name in sorted(tensors)
    }
    content = save(stacked, metadata={"samples": json.dumps(records, sort_keys=True)})
    name = shard_name(index)
    with replacing(folder / name) as temporary:
        temporary.write_bytes(content)
    return Shard(name, hashlib.sha256(content).hexdigest(), records)
