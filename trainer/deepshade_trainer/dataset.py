"""Reads shards by memory mapping, and makes batches of G-buffers and references."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256 as digest_of
from pathlib import Path
from queue import Queue
from threading import Event, Thread
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from torch import Tensor

from deepshade import judging, symmetry, tensors
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade.environments import Surroundings
from deepshade.environments.stored import surroundings_of
from deepshade.errors import DataError
from deepshade.files import sha256
from deepshade.manifest import Manifest, shard_path

Sample = dict[str, NDArray[np.float32]]

# Shares of samples whose lengths have 16 bits, as renderers store them.
HALF_LENGTHS = 0.3
# Shares of samples whose directions are too short, as interpolation and filtering leave them.
SHORT_DIRECTIONS = 0.3
MIN_DIRECTION = 0.8
# Share of a single scene's views that are validated on, at least.
HELD_VIEWS = 0.125


@dataclass(frozen=True)
class Entry:
    """Where a sample lies, and what it was rendered from."""

    path: Path
    digest: str
    index: int
    record: dict[str, Any]

    @property
    def name(self) -> str:
        """For messages: shard, index and scene."""
        return f"{self.path.name}[{self.index}] ({self.record['scene']})"


class Dataset:
    """All samples of one effect in one or several data folders.

    `per_channel` says whether networks see one colour channel; None: as the effect's row does.
    `inputs` are what they see, where that is something else than the effect's inputs.

    Raises:
        DataError: a folder holds no manifest, lacks a shard, or was made for other effects.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        effect: str,
        *,
        per_channel: bool | None = None,
        inputs: Sequence[str] = (),
    ) -> None:
        self.effect = EFFECTS[effect]
        self.inputs = tuple(inputs) or self.effect.inputs
        self.per_channel = self.effect.per_channel if per_channel is None else per_channel
        self.reference = f"reference_{effect}"
        beside = self.effect.trivial_layer
        self.layers = tuple(
            dict.fromkeys([*self.inputs, self.reference, *([beside] if beside else [])])
        )
        self.entries: list[Entry] = []
        self._open: dict[Path, Any] = {}
        for folder in folders:
            manifest = Manifest.read(folder)
            missing = set(self.layers) - set(manifest.schema)
            if missing:
                effects = {effect, *missing.intersection([beside])}
                names = ",".join(sorted(name.removeprefix("reference_") for name in effects))
                more = ",".join(sorted(missing - set(self.effect.inputs) & set(self.inputs)))
                raise DataError(
                    f"{folder} has no {', '.join(sorted(missing))}",
                    fix=f"render it with --effects {names}"
                    + (f" --attributes {more}, or --pixels 512 to train on" if more else ""),
                )
            for shard in manifest.shards:
                path = shard_path(folder, shard)
                if not path.is_file():
                    raise DataError(f"{path} is named by the manifest but missing")
                self.entries += [
                    Entry(path, shard.sha256, k, r) for k, r in enumerate(shard.samples)
                ]

    def split(self, fraction: float, *, seed: int) -> tuple[list[int], list[int]]:
        """Sample numbers to train on and to validate on; no scene is in both, if there are several.

        Scenes are held out by a hash of their name and the run's seed, so more data doesn't move
        them; with a `fraction` above 0 at least one is. Of a single scene views are held out
        alike, at least `HELD_VIEWS` of all.
        """
        names = [str(entry.record["scene"]) for entry in self.entries]
        if self.one_scene:
            names = [str(entry.record.get("seed", entry.name)) for entry in self.entries]
            fraction = max(fraction, HELD_VIEWS) if fraction > 0 else 0.0
        hashes = [_unit(f"{seed}:{name}") for name in names]
        if fraction > 0 and len(set(hashes)) > 1:
            fraction = max(fraction, float(np.nextafter(min(hashes), 1)))
        held = [value < fraction for value in hashes]
        training = [k for k, out in enumerate(held) if not out]
        return training, [k for k, out in enumerate(held) if out]

    @property
    def one_scene(self) -> bool:
        """Whether all samples are of the same scene."""
        return len({entry.record["scene"] for entry in self.entries}) == 1

    def load(self, number: int) -> Sample:
        """Sample `number`: planar float32 attributes in physical units, and its reference."""
        entry, file = self.entries[number], self._file(number)
        return {
            name: file.get_slice(name)[entry.index].astype(np.float32, copy=False)
            for name in self.layers
        }

    def error(self, number: int) -> NDArray[np.float32] | None:
        """The standard error of a sample's reference, shaped alike; None where it isn't stored."""
        entry, file, name = self.entries[number], self._file(number), f"{self.reference}_error"
        if name not in file.keys():  # noqa: SIM118 (not a dict)
            return None
        plane: NDArray[np.float32] = file.get_slice(name)[entry.index]
        return plane.astype(np.float32)

    def _file(self, number: int) -> Any:
        entry = self.entries[number]
        if entry.path not in self._open:
            if sha256(entry.path) != entry.digest:
                raise DataError(
                    f"{entry.path} is not the file that the manifest describes",
                    fix="run the same 'deepshade datagen' again: it renders what is damaged",
                )
            try:
                self._open[entry.path] = safe_open(entry.path, framework="numpy")
            except Exception as error:  # safetensors' own error type says only "invalid header"
                raise DataError(f"{entry.path} can't be read: {error}") from error
        return self._open[entry.path]

    def radius(self, number: int) -> float:
        """The effect radius that a sample was rendered with; 1 for an effect without."""
        return float(self.entries[number].record.get("radius", 1.0))

    def surroundings(self, number: int) -> Surroundings | None:
        """The environment that a sample was rendered under; None where it was under none.

        Raises DataError: the map isn't there.
        """
        entry = self.entries[number]
        return surroundings_of(entry.path.parent, entry.record)

    def gbuffer(self, sample: Sample, radius: float, multiple: int = 1) -> NDArray[np.float32]:
        """What a network sees of a sample (N, C, h, w); N is 3 for networks run per channel.

        Sides are padded to multiples of `multiple`.
        """
        given = self.effect, sample, self.inputs, radius
        return tensors.tensor(*given, per_channel=self.per_channel, multiple=multiple)

    def batch(self, numbers: Sequence[int], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """G-buffers (N, C, H, W) and references (N, outputs, H, W) to learn from.

        Each sample is turned by one of the effect's symmetries (`turn`); some have 16-bit lengths,
        some directions that are too short; networks run per channel see one colour channel.
        """
        drawn = zip(*(self._drawn(number, rng) for number in numbers), strict=True)
        gbuffers, references = (torch.from_numpy(np.stack(each)) for each in drawn)
        return gbuffers, references

    def turn(self, number: int, rng: np.random.Generator) -> int:
        """A symmetry of the effect to turn a sample by; none for one that is a stored turn itself.

        Data sets of 'datagen --augment' hold all of a view's turns.
        """
        drawn = self.effect.symmetries[int(rng.integers(len(self.effect.symmetries)))]
        return 0 if "turn" in self.entries[number].record else drawn

    def _drawn(self, number: int, rng: np.random.Generator) -> tuple[NDArray[np.float32], ...]:
        sample, effect = self.load(number), self.effect
        turn = self.turn(number, rng)
        reference = symmetry.apply(sample[self.reference], None, turn)
        turned = {name: symmetry.apply(sample[name], name, turn) for name in self.effect.inputs}
        if rng.random() < HALF_LENGTHS:
            turned |= {name: rounded(turned[name]) for name in lengths(effect.inputs)}
        if rng.random() < SHORT_DIRECTIONS:
            turned |= shortened(turned, directions(effect.inputs), MIN_DIRECTION, rng)
        channel = int(rng.integers(3)) if self.per_channel else None
        scale = tensors.length_scale(effect, turned, self.radius(number))
        planes = tensors.planes(turned, effect.inputs, scale, channel=channel)
        height, width = planes[0].pixels.shape
        gbuffer = tensors.cut(planes, (0, height, 0, width))[0]
        return gbuffer, reference if channel is None else reference[channel : channel + 1]

    def judged(self, number: int) -> tuple[Tensor, Sample]:
        """What networks are validated on.

        A G-buffer (N, C, H, W) and the sample: attributes, the reference and the answer of doing
        nothing ("trivial"), all (C, H, W).
        """
        sample = self.load(number)
        sample["trivial"] = judging.trivial(
            self.effect, sample, sample[self.reference], self.surroundings(number)
        )
        return torch.from_numpy(self.gbuffer(sample, self.radius(number))), sample


def lengths(names: Iterable[str]) -> list[str]:
    """Those attributes that are lengths."""
    return [name for name in names if ATTRIBUTES[name].unit.scaled]


def directions(names: Iterable[str]) -> list[str]:
    """Those attributes that are unit vectors."""
    return [name for name in names if ATTRIBUTES[name].unit.name.startswith("direction")]


def shortened(
    sample: Sample, names: Iterable[str], shortest: float, rng: np.random.Generator
) -> Sample:
    """These directions (3, H, W), each pixel's by a random factor from `shortest` to 1."""
    found = {}
    for name in names:
        factors = rng.uniform(shortest, 1, (1, *sample[name].shape[1:]))
        found[name] = sample[name] * factors.astype(np.float32)
    return found


def rounded(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """`plane` as 16 bits hold it; unchanged where they can't (beyond 65504)."""
    if np.abs(plane).max() > np.finfo(np.float16).max:
        return plane
    return plane.astype(np.float16).astype(np.float32)


@dataclass(frozen=True)
class Batch:
    """One training step's data."""

    step: int
    numbers: list[int]
    gbuffer: Tensor
    reference: Tensor


def batches(
    data: Dataset, numbers: Sequence[int], size: int, *, seed: int, first: int, last: int
) -> Iterator[Batch]:
    """Batches of steps `first` to `last` - 1, read ahead in a thread.

    The samples of a step depend on `seed` and the step alone, so that a resumed run sees what an
    uninterrupted one would have seen. Every sample comes once before any comes again.
    """
    queue: Queue[Batch | BaseException] = Queue(maxsize=4)
    stop = Event()

    def read() -> None:
        try:
            for step in range(first, last):
                if stop.is_set():
                    return
                chosen = _chosen(numbers, size, seed, step)
                rng = np.random.default_rng([seed, step, 1])
                queue.put(Batch(step, chosen, *data.batch(chosen, rng)))
        except BaseException as error:  # handed to the training loop
            queue.put(error)

    thread = Thread(target=read, daemon=True)
    thread.start()
    try:
        for _ in range(first, last):
            item = queue.get()
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        stop.set()
        while thread.is_alive():
            while not queue.empty():
                queue.get_nowait()
            thread.join(0.05)


def _chosen(numbers: Sequence[int], size: int, seed: int, step: int) -> list[int]:
    chosen = []
    for position in range(step * size, (step + 1) * size):
        epoch, place = divmod(position, len(numbers))
        order = _permutation(len(numbers), seed, epoch)
        chosen.append(numbers[order[place]])
    return chosen


@lru_cache(maxsize=4)
def _permutation(count: int, seed: int, epoch: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, epoch]).permutation(count)


def _unit(text: str) -> float:
    """A hash of `text` in [0, 1)."""
    return int.from_bytes(digest_of(text.encode()).digest()[:8], "little") / 2.0**64


def spread(length: int, count: int) -> list[int]:
    """Up to `count` different numbers below `length`, evenly from first to last."""
    return sorted({int(k) for k in np.linspace(0, length - 1, count)}) if length else []
