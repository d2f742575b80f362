"""Samples kept on the training device, where batches are made too: no GPU waits for a disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from deepshade import symmetry, tensors
from deepshade.attributes import ATTRIBUTES
from deepshade_trainer.dataset import (
    HALF_LENGTHS,
    MIN_DIRECTION,
    SHORT_DIRECTIONS,
    Dataset,
    directions,
    lengths,
)


class Resident(Dataset):
    """A `Dataset` whose samples stay on a device from their first use on.

    Its batches are as `Dataset.batch` makes them, but that 16-bit lengths are rounded after they
    were divided by the radius or the depth, not before.
    """

    def __init__(
        self, folders: Sequence[Path], effect: str, *, per_channel: bool, device: torch.device
    ) -> None:
        super().__init__(folders, effect, per_channel=per_channel)
        self.device = device
        self._kept: dict[int, tuple[Tensor, Tensor]] = {}
        self._places = tensors.channel_slices(self.effect.inputs, per_channel=False)
        self._turns = [
            torch.tensor(self._turn(each), dtype=torch.float32, device=device)
            for each in symmetry.ALL
        ]
        self._channels = [self._coloured(channel) for channel in range(3)] if per_channel else None

    def batch(self, numbers: Sequence[int], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """See `Dataset.batch`."""
        effect, inputs, references = self.effect, [], []
        for number in numbers:
            gbuffer, reference = self._sample(number)
            turn = self.turn(number, rng)
            gbuffer = torch.einsum("ij,jhw->ihw", self._turns[turn], _moved(gbuffer, turn))
            reference = _moved(reference, turn)
            if rng.random() < HALF_LENGTHS:
                for name in lengths(effect.inputs):
                    place = self._places[name]
                    gbuffer[place] = gbuffer[place].half().float()
            if rng.random() < SHORT_DIRECTIONS:
                # A generator of its own: a step's batch depends on the step alone.
                noise = torch.Generator(self.device).manual_seed(int(rng.integers(2**63)))
                for name in directions(effect.inputs):
                    shape = (1, *gbuffer.shape[1:])
                    factors = torch.rand(shape, generator=noise, device=self.device)
                    factors = factors * (1 - MIN_DIRECTION)
                    gbuffer[self._places[name]] *= factors + MIN_DIRECTION
            if self._channels:
                channel = int(rng.integers(3))
                gbuffer, reference = gbuffer[self._channels[channel]], reference[channel, None]
            inputs.append(gbuffer)
            references.append(reference)
        return torch.stack(inputs), torch.stack(references)

    def _sample(self, number: int) -> tuple[Tensor, Tensor]:
        """All channels of the inputs (C, H, W), scaled, and the reference, on the device."""
        if number not in self._kept:
            sample = self.load(number)
            scale = tensors.length_scale(self.effect, sample, self.radius(number))
            height, width = sample[self.reference].shape[1:]
            planes = tensors.planes(sample, self.effect.inputs, scale)
            pair = tensors.cut(planes, (0, height, 0, width))[0], sample[self.reference]
            gbuffer, reference = (torch.from_numpy(each).to(self.device) for each in pair)
            self._kept[number] = gbuffer, reference
        return self._kept[number]

    def _turn(self, turn: int) -> np.ndarray:
        """(C, C) what a symmetry does to a pixel's channels: `symmetry.apply` to each alone."""
        count = max(place.stop for place in self._places.values())
        alone = np.eye(count, dtype=np.float32)[:, :, None, None]
        parts = [
            symmetry.apply(alone[:, place], name, turn) for name, place in self._places.items()
        ]
        return np.concatenate(parts, 1)[:, :, 0, 0].T

    def _coloured(self, channel: int) -> list[int]:
        """The channels that a run for one colour channel sees."""
        found: list[int] = []
        for name, place in self._places.items():
            all_of_it = range(place.start, place.stop)
            found += [all_of_it[channel]] if ATTRIBUTES[name].coloured else all_of_it
        return found


def _moved(planes: Tensor, turn: int) -> Tensor:
    """(C, H, W) with the pixels moved by a symmetry; their values stay."""
    if turn & 1:
        planes = planes.flip(-1)
    if turn & 2:
        planes = planes.flip(-2)
    return planes.transpose(-1, -2) if turn & 4 else planes
