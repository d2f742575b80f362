"""A tiny data set whose answer is simple, and a tiny recipe."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from deepshade.camera import Camera
from deepshade.gbuffer.derivation import normals_from_positions
from deepshade.manifest import Manifest, Shard
from deepshade_trainer.networks import FoldConfig
from deepshade_trainer.recipe import Recipe

SIZE = 64


def sample(seed: int) -> dict[str, np.ndarray]:
    """A wavy surface, darker where it lies below its surroundings."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    a, b, c = rng.uniform(4, 14, 3)
    wave = np.sin(a * x + c) * np.sin(b * y)
    depth = (4 + 0.3 * wave).astype(np.float32)
    depth[: SIZE // 8] = np.inf
    position = Camera(50, SIZE, SIZE).position_from_depth(depth)
    valid = np.isfinite(depth)
    position[:, ~valid] = 0
    normal = normals_from_positions(position, valid)
    visibility = np.where(valid, 0.6 - 0.35 * wave, 1.0)
    return {
        "position": position.astype(np.float32),
        "normal": normal.astype(np.float16),
        "reference_ao": visibility[None].astype(np.float16),
        "reference_ao_error": np.zeros((1, SIZE, SIZE), np.float16),
    }


def write_data(folder: Path, count: int = 24, broken: tuple[int, ...] = ()) -> Path:
    """A data folder of two shards; the samples numbered `broken` hold a NaN."""
    folder.mkdir(parents=True, exist_ok=True)
    samples = [sample(k) for k in range(count)]
    for k in broken:
        samples[k]["position"][0, 30, 30] = np.nan
    schema = {
        name: {"dtype": str(v.dtype), "shape": list(v.shape)} for name, v in samples[0].items()
    }
    manifest = Manifest({"test": True}, schema)
    for index in range(2):
        numbers = range(index * count // 2, (index + 1) * count // 2)
        content = save({n: np.stack([samples[k][n] for k in numbers]) for n in schema})
        name = f"shard-{index:05d}.safetensors"
        (folder / name).write_bytes(content)
        records: list[dict[str, Any]] = [
            {"scene": f"wave:{k // 2}", "seed": k, "radius": 0.5, "camera": {}} for k in numbers
        ]
        manifest = manifest.with_shard(Shard(name, hashlib.sha256(content).hexdigest(), records))
    manifest.write(folder)
    return folder


@pytest.fixture(scope="session")
def data(tmp_path_factory: Any) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "waves")


@pytest.fixture
def recipe() -> Recipe:
    network = FoldConfig(
        widths=(8, 12), steps=(2,), down=(1, 1), up=(1,), normal=0, position=3, bias=0.85
    )
    return Recipe(network=network, batch=4, steps=6, warmup=2, val_fraction=0.2, precision="fp32")
