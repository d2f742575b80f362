"""Losses against the metrics, which have their own independent tests."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from deepshade import metrics
from deepshade.effects import EFFECTS
from deepshade.errors import ConfigError
from deepshade_trainer.losses import dssim, parse_loss
from deepshade_trainer.networks import Shader, build
from deepshade_trainer.recipe import preset


def pair(seed: int = 0, offset: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    a = torch.rand(2, 1, 40, 33, generator=generator)
    b = (a + 0.2 * torch.rand(2, 1, 40, 33, generator=generator)).clamp(0, 1)
    return a + offset, b + offset


@pytest.mark.parametrize("offset", [0.0, 5.0])
def test_dssim_is_the_metrics(offset: float) -> None:
    a, b = pair(offset=offset)
    expected = np.mean([metrics.dssim(x.numpy(), y.numpy()) for x, y in zip(a, b, strict=True)])
    assert float(dssim(a, b)) == pytest.approx(expected, rel=1e-4)


def test_dssim_of_an_image_smaller_than_a_window() -> None:
    a, b = torch.rand(1, 1, 3, 5), torch.rand(1, 1, 3, 5)
    assert float(dssim(a, b)) == pytest.approx(metrics.dssim(a[0], b[0]), rel=1e-4)


def test_sums() -> None:
    a, b = pair()
    l1, l2 = (a - b).abs().mean(), (a - b).square().mean()
    assert float(parse_loss("l1")(a, b)) == pytest.approx(float(l1))
    assert float(parse_loss("l2 + 0.5 l1")(a, b)) == pytest.approx(float(l2 + 0.5 * l1))
    expected = float(dssim(a, b) + 2 * l2)
    assert float(parse_loss("dssim + 2*l2")(a, b)) == pytest.approx(expected)


def test_gradients_of_flat_images_are_finite() -> None:
    image = torch.full((1, 1, 16, 16), 0.5, requires_grad=True)
    dssim(image, torch.ones(1, 1, 16, 16)).backward()
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()


@pytest.mark.parametrize("text", ["", "l3", "dssim +", "-1 l1", "dssim l1"])
def test_unknown_terms_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_loss(text)


def test_a_black_reference_teaches_without_overflow() -> None:
    """As it is judged: what is all black is not exposed."""
    shader = Shader(EFFECTS["gi"], build(preset("balanced", "gi").network))
    image = torch.full((1, 3, 16, 16), -1e-3, requires_grad=True)
    loss = dssim(*shader.compared(image, torch.zeros(1, 3, 16, 16)))
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(image.grad).all()
