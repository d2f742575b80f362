"""The shipped samples as data sets: what must not get worse where nothing else is given."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.environments import Environment, sky
from deepshade.environments.stored import store
from deepshade.files import replacing, shipped
from deepshade.gbuffer import load_gbuffer
from deepshade.manifest import Manifest, Shard


def as_data(folder: Path, effect: str) -> list[Path]:
    """A data folder below `folder` for each sample that has a reference of the effect.

    What the effect takes is derived where a file leaves it out. The same samples give the same
    bytes.
    """
    found = (_written(path, folder / path.stem, effect) for path in _files())
    return [each for each in found if each is not None]


def _files() -> list[Path]:
    return sorted(shipped("samples").glob("*.exr"))


def _written(path: Path, folder: Path, effect: str) -> Path | None:
    row = EFFECTS[effect]
    inside = {name for part in exr.read_header(path.read_bytes()).parts for name in part.channels}
    bands = ("V",) if len(row.outputs) == 1 else row.outputs

    def layer(name: str) -> Any:
        """(C, H, W), or None where the file has no such layer."""
        channels = [f"{name}.{band}" for band in bands]
        return exr.read(path, channels).stack(channels) if inside.issuperset(channels) else None

    planes: dict[str, Any] = {f"reference_{effect}": layer(f"reference_{effect}")}
    if planes[f"reference_{effect}"] is None:
        return None
    beside = row.trivial_layer
    attributes = [*row.inputs, *([beside] if beside in ATTRIBUTES else [])]
    loaded = load_gbuffer(path, list(dict.fromkeys(attributes)))
    planes |= loaded.attributes
    if beside and beside not in planes:
        planes[beside] = layer(beside)
    header = loaded.header
    record = {"scene": str(header.get("deepshade:scene", path.stem)), "seed": 0}
    settings = {name: header.get(SETTINGS[name].header) for name in row.settings}
    record |= {name: value for name, value in settings.items() if value is not None}
    folder.mkdir(parents=True, exist_ok=True)
    record |= _surroundings(header, folder)
    stacked = {name: np.ascontiguousarray(v, np.float32)[None] for name, v in planes.items()}
    content = save(stacked)
    name = "shard-00000.safetensors"
    with replacing(folder / name) as temporary:
        temporary.write_bytes(content)
    schema = {n: {"dtype": "float32", "shape": list(v.shape[1:])} for n, v in stacked.items()}
    shard = Shard(name, hashlib.sha256(content).hexdigest(), [record])
    Manifest({"sample": path.name}, schema, [shard]).write(folder)
    return folder


def _surroundings(header: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The record's entries for the sky that the service has, where the header says that it lit."""
    if header.get("deepshade:environment_sha256") != _sky().sha256:
        return {}
    store(folder, _sky())
    degrees = float(header.get("deepshade:rotate", 0.0))
    return {"environment": "sky", "environment_sha256": _sky().sha256, "rotate": degrees}


@lru_cache(maxsize=1)
def _sky() -> Environment:
    return sky(height=512)
