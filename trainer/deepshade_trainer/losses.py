"""Losses on (N, C, H, W) images: L1, L2, DSSIM and weighted sums of them."""

from __future__ import annotations

import re
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade.errors import ConfigError

Loss = Callable[[Tensor, Tensor], Tensor]

C1, C2, WINDOW = 1e-4, 1e-3, 8


def l1(image: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference."""
    return F.l1_loss(image, reference)


def l2(image: Tensor, reference: Tensor) -> Tensor:
    """Mean squared difference."""
    return F.mse_loss(image, reference)


def dssim(image: Tensor, reference: Tensor) -> Tensor:
    """(1 - SSIM) / 2 with uniform 8 x 8 windows at stride 1 (paper, section 4.3); in [0, 1].

    Images smaller than a window are one window. Values are first made relative to the
    reference's mean, so that little cancels in a window's E[x²] - E[x]².
    """
    high, wide = (min(WINDOW, side) for side in image.shape[-2:])

    def mean(x: Tensor) -> Tensor:
        return _summed(_summed(x, high, 2), wide, 3) * (1 / (high * wide))

    x, y = image.float(), reference.float()
    center = y.mean((2, 3), keepdim=True)
    xc, yc = x - center, y - center
    mx, my = mean(xc), mean(yc)
    vx = (mean(xc * xc) - mx * mx).clamp_min(0)
    vy = (mean(yc * yc) - my * my).clamp_min(0)
    cov = mean(xc * yc) - mx * my
    ax, ay = mx + center, my + center
    ssim = (2 * ax * ay + C1) * (2 * cov + C2) / ((ax**2 + ay**2 + C1) * (vx + vy + C2))
    return (1 - ssim.mean()) / 2


def _summed(x: Tensor, count: int, axis: int) -> Tensor:
    """Sums of `count` neighbours along an axis, by halves: far quicker than pooling."""
    if count == 1:
        return x
    half = count // 2
    sums = _summed(x, half, axis)
    length = x.shape[axis] - count + 1
    found = sums.narrow(axis, 0, length) + sums.narrow(axis, half, length)
    return found + x.narrow(axis, count - 1, length) if count % 2 else found


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "dssim": dssim}


def parse_loss(text: str) -> Loss:
    """A loss from text such as `dssim`, or `dssim + 0.5 l1`.

    Raises:
        ConfigError: a term is not `[weight] name` with a known name.
    """
    terms: list[tuple[float, Loss]] = []
    for term in text.split("+"):
        match = re.fullmatch(r"\s*([0-9.]+)?\s*\*?\s*([a-z0-9]+)\s*", term)
        if match is None or match[2] not in LOSSES:
            raise ConfigError(
                term.strip(), LOSSES, detail=f"unknown loss {term.strip()!r} in {text!r}"
            )
        terms.append((float(match[1] or 1), LOSSES[match[2]]))

    def total(image: Tensor, reference: Tensor) -> Tensor:
        return torch.stack([weight * loss(image, reference) for weight, loss in terms]).sum()

    return total
