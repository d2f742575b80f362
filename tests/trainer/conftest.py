"""A tiny data set whose answer is simple, and a tiny recipe."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from deepshade.camera import Camera
from deepshade.gbuffer.derivation import normals_from_positions
from deepshade.manifest import Manifest, Shard
from deepshade_trainer.export import export
from deepshade_trainer.networks import FoldConfig
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run
from deepshade_trainer.training import train
from deepshade_trainer.tuning.plan import Plan

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


def write_data(
    folder: Path,
    count: int = 24,
    broken: tuple[int, ...] = (),
    reference: Callable[[tuple[int, ...]], np.ndarray] | None = None,
) -> Path:
    """A data folder of two shards; the samples numbered `broken` hold a NaN.

    `reference` makes references of a shape in place of the right ones.
    """
    folder.mkdir(parents=True, exist_ok=True)
    samples = [sample(k) for k in range(count)]
    for each in samples if reference else ():
        shape = each["reference_ao"].shape
        each["reference_ao"] = reference(shape).astype(np.float16)
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


NETWORK = FoldConfig(
    widths=(8, 12), steps=(2,), down=(1, 1), up=(1,), normal=0, position=3, bias=0.85
)


@pytest.fixture
def recipe() -> Recipe:
    return Recipe(network=NETWORK, batch=4, steps=6, warmup=2, val_fraction=0.2, precision="fp32")


@pytest.fixture(scope="session")
def base(data: Path, tmp_path_factory: Any) -> Path:
    """A bundle `ao/balanced` that has learnt next to nothing."""
    folder = tmp_path_factory.mktemp("base")
    recipe = Recipe(network=NETWORK, batch=4, steps=2, warmup=1, precision="fp32")
    list(train(recipe, [data], Run(folder / "run")))
    return export(Run(folder / "run"), folder / "models/ao/balanced", [data])[0].path


@pytest.fixture(scope="session")
def judges(tmp_path_factory: Any) -> Path:
    """A few views that must not get worse."""
    return write_data(tmp_path_factory.mktemp("judges") / "test", 2)


@pytest.fixture(scope="session")
def plan(base: Path, data: Path, judges: Path) -> Plan:
    """A job that makes `base` better in moments."""
    return Plan(
        effect="ao",
        base=str(base),
        name="balanced",
        data=(str(data),),
        test=(str(judges),),
        steps=10,
        batch=4,
        lr=4e-3,
        slower=10.0,
    )
