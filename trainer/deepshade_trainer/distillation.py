"""Data whose references are a bundle's answers, for a smaller network to learn from: distillation.

The teacher sees every view turned in each way that the effect allows, and its answers are averaged:
I. Radosavovic et al., *Data Distillation: Towards Omni-Supervised Learning* (CVPR 2018), section 3.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from deepshade import symmetry
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, Backend
from deepshade.environments.stored import FOLDER
from deepshade.errors import ConfigError, DataError
from deepshade.files import sha256
from deepshade.manifest import NAME, Manifest, shard_path, write_shard
from deepshade_trainer.dataset import TEACHER, Dataset
from deepshade_trainer.evaluation import Image, Shaded


def distill(
    bundle: Bundle, folder: Path, out: Path, backend: Backend = REFERENCE
) -> Iterator[tuple[int, int]]:
    """Write the data in `folder` anew to `out`, with answers of `bundle` as references.

    Trainings take both folders, and so learn from both; what is taught is never validated on. What
    `out` has of the same teacher and data stays. Yields (samples done, samples in all).

    Raises:
        DataError: `out` holds other data.
        ConfigError: the bundle is a perceptron, whose samples are no pictures.
    """
    if bundle.network.get("kind") == "perceptron":
        raise ConfigError(
            "bundle",
            detail=f"{bundle.effect}/{bundle.name} is a perceptron, which sees no pictures: "
            "let another bundle teach",
        )
    data = Dataset([folder], bundle.effect, per_channel=bundle.per_channel, inputs=bundle.inputs)
    source = Manifest.read(folder)
    manifest = _begun(bundle, source, data, out)
    if (folder / FOLDER).is_dir():
        shutil.copytree(folder / FOLDER, out / FOLDER, dirs_exist_ok=True)
    shaded, done, first = Shaded(bundle, backend), 0, 0
    for shard in source.shards:
        numbers = range(first, first + len(shard.samples))
        first = numbers.stop
        if _complete(out, manifest, shard.file):
            done += len(numbers)
            yield done, source.count
            continue
        samples = []
        for number in numbers:
            sample = data.load(number)
            sample[data.reference] = taught(shaded, data, number)
            samples.append(sample)
            done += 1
            yield done, source.count
        tensors = {
            name: np.stack([sample[name] for sample in samples]).astype(row["dtype"])
            for name, row in manifest.schema.items()
        }
        records = [{**record, TEACHER: bundle.sha256} for record in shard.samples]
        manifest = manifest.with_shard(write_shard(out, shard.file, tensors, records))
        manifest.write(out)


def taught(shaded: Shaded, data: Dataset, number: int) -> Image:
    """The mean answer (C, H, W) to a sample that is turned by each of the effect's symmetries."""
    sample, answers = data.load(number), []
    for turn in data.effect.symmetries:
        turned = {name: symmetry.apply(plane, name, turn) for name, plane in sample.items()}
        answer = shaded(data, turned, data.radius(number), data.surroundings(number))
        answers.append(symmetry.apply(answer, None, symmetry.inverse(turn)))
    mean: Image = np.mean(answers, 0, dtype=np.float32)
    return mean


def _begun(bundle: Bundle, source: Manifest, data: Dataset, out: Path) -> Manifest:
    """The manifest to go on with."""
    settings = {**source.settings, TEACHER: bundle.sha256}
    schema = {name: source.schema[name] for name in sorted(data.layers)}
    out.mkdir(parents=True, exist_ok=True)
    if not (out / NAME).exists():
        return Manifest(settings, schema)
    begun = Manifest.read(out)
    if begun.settings != settings:
        raise DataError(
            f"{out} holds other data, or another bundle taught it", fix="give another --out"
        )
    return begun


def _complete(out: Path, manifest: Manifest, file: str) -> bool:
    """Whether `out` has that shard whole."""
    for shard in manifest.shards:
        if shard.file == file:
            path = shard_path(out, shard)
            return path.is_file() and sha256(path) == shard.sha256
    return False
