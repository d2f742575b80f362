"""Small data sets and bundles of any effect, from arrays that nothing rendered."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock
from safetensors.numpy import save

from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.bundles import CONFIG, Bundle, bundle_root
from deepshade.effects import EFFECTS
from deepshade.environments import Environment
from deepshade.environments.stored import store
from deepshade.errors import ConfigError
from deepshade.manifest import Manifest, Shard
from deepshade_trainer.export import export
from deepshade_trainer.recipe import Recipe, preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import train

SIZE = 64
RADIUS = 0.5
# What a fold network of a few thousand parameters is, instead of a preset's million.
TRUNK: dict[str, Any] = {"widths": (8, 12), "steps": (2,), "down": (1, 1), "up": (1,)}
SMALL = TRUNK | {"rings": (1,), "fine_rings": (1, 2), "detail": ()}


def arrays(effect: str, seed: int, height: int = SIZE, width: int = SIZE) -> dict[str, Any]:
    """Inputs (C, H, W) of an effect: light up to 1e5, and nothing in the upper half but sky."""
    rng = np.random.default_rng(seed)
    half = height // 2
    y, x = np.mgrid[0:height, 0:width] / SIZE
    depth = 4 + 0.3 * np.sin(9 * x + seed) * np.sin(7 * y)
    position = np.stack([(x - 0.5) * depth, (0.5 - y) * depth, -depth])
    found: dict[str, Any] = {}
    for name in EFFECTS[effect].inputs:
        attribute, shape = ATTRIBUTES[name], (len(ATTRIBUTES[name].channels), height, width)
        if name == "position":
            planes = position
        elif name == "depth":
            planes = depth[None]
        elif attribute.unit is RADIANCE:
            planes = 10 ** rng.uniform(-3, 5, shape)
            planes[:, -1, -1] = 1e5
        elif attribute.unit.name.startswith("direction"):
            planes = rng.normal(size=shape) + np.float32([0, 0, 2]).reshape(3, 1, 1)
            planes /= np.linalg.norm(planes, axis=0)
        else:
            planes = rng.random(shape)
        planes = planes.astype(attribute.unit.storage)
        if not attribute.in_background:
            planes[:, :half] = 0
        found[name] = planes
    return found


def reference(effect: str, inputs: dict[str, Any], seed: int) -> Any:
    """An answer (C, H, W) with something to show: its background as the row says."""
    row = EFFECTS[effect]
    _, height, width = next(iter(inputs.values())).shape
    image = np.random.default_rng([seed, 1]).random((len(row.outputs), height, width))
    if row.is_light:
        image = 10 ** (8 * image - 3)
    if isinstance(row.background, float):
        image[:, : height // 2] = row.background
    elif row.background == "light":
        image[:, : height // 2] = inputs["light"][:, : height // 2]
    return image.astype(row.storage)


def write_data(folder: Path, effect: str, count: int = 8) -> Path:
    """A data folder of one shard with `count` views of as many scenes."""
    folder.mkdir(parents=True, exist_ok=True)
    samples = []
    for seed in range(count):
        inputs = arrays(effect, seed)
        answer = reference(effect, inputs, seed)
        sample = {**inputs, f"reference_{effect}": answer}
        if (beside := EFFECTS[effect].trivial_layer) is not None:
            sample.setdefault(beside, answer[::-1] / 2)  # with something to show beside the answer
        samples.append(sample)
    schema = {
        name: {"dtype": str(v.dtype), "shape": list(v.shape)} for name, v in samples[0].items()
    }
    content = save({name: np.stack([sample[name] for sample in samples]) for name in schema})
    (folder / "shard-00000.safetensors").write_bytes(content)
    camera = {"world_to_camera": np.eye(4).tolist()}
    record: dict[str, Any] = {"radius": RADIUS, "camera": camera}
    if "environment" in EFFECTS[effect].settings:
        white = Environment("white", np.ones((3, 8, 16), np.float32))
        store(folder, white)
        record |= {"environment": "white", "environment_sha256": white.sha256, "rotate": 0.0}
    records = [{"scene": f"noise:{k}", "seed": k, **record} for k in range(count)]
    shard = Shard("shard-00000.safetensors", hashlib.sha256(content).hexdigest(), records)
    Manifest({"test": True}, schema).with_shard(shard).write(folder)
    return folder


def learns(effect: str) -> bool:
    """Whether the balanced shader of an effect is learnt, not calculated."""
    try:
        preset("balanced", effect)
    except ConfigError:
        return False
    return True


LEARNT = [effect for effect in EFFECTS if learns(effect)]


def small(effect: str, name: str) -> Recipe:
    """A preset, its network small if it is ours, for one step of two views."""
    change = {"steps": 1, "batch": 2, "val_fraction": 0.2, "precision": "fp32"}
    recipe = preset(name, effect).changed(**change)
    shape = {"fold": SMALL, "carrier": TRUNK}.get(recipe.network.kind, {})
    return recipe.changed(network=shape)


def make_bundle(effect: str, root: Path, name: str = "balanced") -> Bundle:
    """`root`/<effect>/<name>: a bundle of an effect's preset, trained for one step, or the shipped
    one that is calculated.

    The run and the data are in `root`/runs and `root`/data. What another test made there, of this
    process or another, is taken: to export some of these takes half a minute.
    """
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / f"{effect}-{name}.lock"):
        folder, data = root / effect / name, root / "data" / effect
        if name == "balanced" and effect not in LEARNT:
            shutil.copytree(bundle_root() / effect / name, folder, dirs_exist_ok=True)
        elif not (folder / CONFIG).exists():
            run = Run(root / "runs" / effect / name)
            list(train(small(effect, name), [write_data(data, effect)], run))
            export(run, folder, [data], radius=RADIUS)
    return Bundle.load(folder)
