"""What a shader answers to samples that it didn't learn from, beside their references."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from deepshade import judging
from deepshade_trainer.dataset import Dataset
from deepshade_trainer.losses import dssim
from deepshade_trainer.networks import Shader


@dataclass(frozen=True)
class Validated:
    """A sample's errors, and its picture (1, C, H, W): ours, the reference, the difference."""

    dssim: float
    mae: float
    trivial_dssim: float
    picture: Tensor


def answered(shader: Shader, gbuffer: Tensor) -> Tensor:
    """The answer on the transfer curve, as large as the G-buffer."""
    height, width = gbuffer.shape[2:]
    return shader.on_curve(shader.padded(gbuffer))[:, :, :height, :width]


def validated(
    shader: Shader, data: Dataset, numbers: Sequence[int], device: torch.device
) -> Iterator[Validated]:
    """The errors of a shader in evaluation mode over these samples, exposed and clipped."""
    for number in numbers:
        gbuffer, sample = data.judged(number)
        with torch.inference_mode():
            found = shader.bounded(answered(shader, gbuffer.to(device)))
        answer = found.cpu().flatten(0, 1).numpy()
        reference, blank = sample[data.reference], sample["trivial"]
        image, truth, nothing = (
            torch.from_numpy(each)[None]
            for each in judging.exposed(data.effect, reference, answer, reference, blank)
        )
        error = (image - truth).abs()
        yield Validated(
            float(dssim(image, truth)),
            float(error.mean()),
            float(dssim(nothing, truth)),
            torch.cat([image, truth, error], 3),
        )
