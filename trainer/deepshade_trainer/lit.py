"""Samples of what is open to which directions, to learn from under any light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from deepshade import symmetry
from deepshade.camera import rotation_of
from deepshade.environments.environment import directions, world_to_map
from deepshade.environments.lamps import DIRECTIONS, gathered, lamps, nearest
from deepshade.environments.stored import read_stored
from deepshade.errors import DataError
from deepshade_trainer.dataset import Dataset, Sample
from deepshade_trainer.networks.openings import LEVEL
from deepshade_trainer.networks.slices import lobes

Float = NDArray[np.float32]

SIDE = 256  # of the part of a sample that is learnt from at a time
MAPS = 3  # that it is learnt under at a time
WHITE, LAMPS = 0.15, 0.25  # shares of these that are white, and three lamps
AMBIENT = 0.05, 0.5  # beside a lamp: share of its irradiance where it falls straight in
_ROWS = 64  # of a table of irradiance
_COUNT = len(DIRECTIONS)
# (256, 8): the bits of each byte, the highest first
_BITS = torch.from_numpy(np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1)).float()
# (3, 3) what each symmetry does to camera space
_TURNS = [symmetry.apply(np.eye(3)[:, :, None, None], "normal", k)[..., 0, 0].T for k in range(8)]


class Lit(Dataset):
    """Samples with a layer `reference_<effect>_directions`, relit by lamps in those directions.

    The reference under lamps is exact, without noise: a sum over those that are open.
    """

    def __init__(self, folders: Sequence[Path], effect: str) -> None:
        super().__init__(folders, effect, per_channel=False)
        self.layer = f"{self.reference}_directions"
        self._lobes = [lobes(DIRECTIONS @ turn.T, 2.0**LEVEL) for turn in _TURNS]
        grid = DIRECTIONS @ directions(_ROWS, 2 * _ROWS).reshape(3, -1)
        self._cosines = torch.from_numpy(np.maximum(grid, 0).astype(np.float32))
        for entry in self.entries:
            if "environment_sha256" not in entry.record:
                raise DataError(
                    f"{entry.path} was rendered without environments", fix=f"--effects {effect}"
                )

    def judged(self, number: int) -> tuple[Tensor, tuple[Tensor, ...], Sample]:
        """See `Dataset.judged`: under the sample's own map."""
        sample = self.load(number)
        record = self.entries[number].record
        light = self._map(number, number, record["rotate"])
        whole = slice(None), slice(None)
        reference, irradiance = self._relit(number, sample["normal"], light, whole)
        sample |= {self.reference: reference, "trivial": irradiance}
        gbuffer = torch.from_numpy(self.gbuffer(sample, self.radius(number)))
        given = (irradiance[None], self._through(light, 0)[None])
        return gbuffer, tuple(map(torch.from_numpy, given)), sample

    def batch(self, numbers: Sequence[int], rng: np.random.Generator) -> tuple[Tensor, ...]:
        """G-buffers (N, C, H, W), references (N J, 3, H, W), and what `Shader.lit` takes."""
        gbuffer, reference, *light = super().batch(numbers, rng)
        return gbuffer, reference.reshape(-1, 3, *reference.shape[2:]), *light

    def _drawn(self, number: int, rng: np.random.Generator) -> tuple[Float, ...]:
        sample = self.load(number)
        part = tuple(_part(side, rng) for side in sample["normal"].shape[1:])
        sample = {name: plane[:, *part] for name, plane in sample.items()}
        light = np.concatenate(
            [self._light(number, sample["normal"], rng) for _ in range(MAPS)], axis=1
        )
        pair = self._relit(number, sample["normal"], light, part)
        turn = int(rng.integers(len(_TURNS)))
        gbuffer, _ = self._seen(number, sample, turn, rng)
        relit = (symmetry.apply(image, None, turn) for image in pair)
        return (gbuffer, *relit, self._through(light, turn))

    def _packed(self, number: int, part: tuple[slice, ...]) -> NDArray[np.uint8]:
        file, index = self._file(number), self.entries[number].index
        found: NDArray[np.uint8] = file.get_slice(self.layer)[index, :, *part]
        return found

    def _light(self, number: int, normal: Float, rng: np.random.Generator) -> Float:
        """(directions, 3): white, lamps, or the map of any sample, turned by any angle."""
        kind = rng.random()
        if kind < WHITE:
            return np.ones((_COUNT, 3), np.float32)
        if kind < WHITE + LAMPS:
            return _lamps(normal, rng)
        return self._map(number, int(rng.integers(len(self.entries))), rng.uniform(0, 360))

    def _map(self, number: int, other: int, degrees: float) -> Float:
        """(directions, 3): the map of the `other` sample around this one, as lamps' flux."""
        record = self.entries[number].record
        entry = self.entries[other]
        toward, light = _lamps_of(entry.path.parent, entry.record["environment_sha256"])
        camera = rotation_of(np.array(record["camera"]["world_to_camera"]))
        toward = toward @ world_to_map(degrees) @ camera.T
        found = gathered(light, nearest(toward, DIRECTIONS), _COUNT)
        return (found * (_COUNT / (4 * math.pi))).astype(np.float32)

    def _relit(
        self, number: int, normals: Float, light: Float, part: tuple[slice, ...]
    ) -> tuple[Float, Float]:
        """The reference and the open surface's irradiance over π, (C, H, W), of (directions, C).

        `normals` (3, H, W) are those of this part (rows and columns) of the sample.
        A direction's light is the radiance of the solid angle that it stands for.
        """
        packed = self._packed(number, part)
        normal = torch.from_numpy(np.ascontiguousarray(normals))
        flux = torch.from_numpy((light * (4 / _COUNT)).astype(np.float32))  # over π
        toward = torch.from_numpy(DIRECTIONS).float()
        colours, size = flux.shape[1], normal.shape[1:]
        # What a byte of 8 directions adds is looked up: 6 times as fast as unpacking them.
        eights = (flux[:, :, None] * toward[:, None]).reshape(_COUNT // 8, 8, colours * 3)
        sums = (_BITS @ eights).flatten(0, 1)  # (directions / 8 * 256, 3 C)
        bytes_ = torch.from_numpy(packed.reshape(len(packed), -1).T.astype(np.int32))
        bytes_ += 256 * torch.arange(len(packed), dtype=torch.int32)
        moments = F.embedding_bag(bytes_, sums, mode="sum").T
        vectors = moments.reshape(colours, 3, *size)
        reference = (vectors * normal).sum(1).clamp_min(0)
        table = (flux.T @ self._cosines).reshape(1, colours, _ROWS, 2 * _ROWS)
        irradiance = _looked_up(table, normal)
        background = (normal * normal).sum(0) < 0.25
        mean = torch.from_numpy(light.mean(0, dtype=np.float64)).float()[:, None]
        for image in (reference, irradiance):
            image[:, background] = mean
        return reference.numpy(), irradiance.numpy()

    def _through(self, light: Float, turn: int) -> Float:
        """(C, TERMS, SECTORS): light through lobes, in a camera space turned by a symmetry."""
        return np.asarray((self._lobes[turn] @ light).transpose(2, 0, 1), np.float32)


def _part(side: int, rng: np.random.Generator) -> slice:
    """`SIDE` of `side` pixels."""
    start = int(rng.integers(max(0, side - SIDE) + 1))
    return slice(start, start + min(SIDE, side))


def _lamps(normal: Float, rng: np.random.Generator) -> Float:
    """(directions, 3): each colour from one lamp before some pixel's surface, and all around."""
    light = np.ones((_COUNT, 3), np.float32)
    for band in range(3):
        row, column = (int(rng.integers(side)) for side in normal.shape[1:])
        toward = rng.normal(size=3)
        toward = toward / np.linalg.norm(toward) + normal[:, row, column]
        light[:, band] *= rng.uniform(*AMBIENT)
        light[nearest(toward[None], DIRECTIONS), band] += _COUNT / 4
    return light


@lru_cache(maxsize=128)
def _lamps_of(folder: Path, digest: str) -> tuple[Any, Any]:
    return lamps(read_stored(folder, digest))


def _looked_up(table: Tensor, normal: Tensor) -> Tensor:
    """(C, H, W): a latitude-longitude `table` (1, C, h, 2 h) at the directions (3, H, W)."""
    x, y, z = normal
    width = table.shape[3]
    wide = F.pad(table, (1, 1, 0, 0), "circular")
    u = (torch.atan2(x, -z) / (2 * math.pi) + 0.5) * width + 1
    v = torch.atan2(torch.hypot(x, z), y) / math.pi
    grid = torch.stack([u * (2 / (width + 2)) - 1, v * 2 - 1], 2)[None]
    return F.grid_sample(wide, grid, padding_mode="border", align_corners=False)[0]
