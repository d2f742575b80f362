"""Networks: published sizes, locality, scale, background, awkward input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from deepshade_trainer.networks import NetworkConfig, Shader, build

PAPER = {
    # effect: u0, levels, inputs, outputs, parameters published by the authors
    "ao": (8, 6, 6, 1, 71_089),
    "dof": (8, 5, 2, 1, 33_553),
    "gi": (16, 5, 7, 1, 133_489),
    "do": (16, 5, 9, 3, 134_643),
    "mb": (16, 5, 4, 1, 133_057),
}
SMALL = NetworkConfig(
    widths=(8, 12, 16),
    steps=(2, 2),
    down=(1, 2, 2),
    up=(1, 2),
    fold=2,
    rings=(1, 2),
    fine_rings=(1, 1, 3),
    detail=(),
)
WIDE = NetworkConfig(
    widths=(8, 12), steps=(4,), down=(0, 2), up=(1,), fold=4, rings=(1, 1), fine_rings=(1, 2, 5, 4)
)
DETAILED = NetworkConfig(
    widths=(8, 12),
    steps=(2,),
    down=(1, 1),
    up=(1,),
    fold=4,
    rings=(1,),
    fine_rings=(1,),
    detail=(9, 1),
)
SMALL_PAPER = NetworkConfig(kind="paper", widths=(4, 8, 16))


def awake(config: NetworkConfig, seed: int = 0) -> Shader:
    """A network whose layers all do something, in evaluation mode."""
    torch.manual_seed(seed)
    model = build(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model.eval()


def scene(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """A random bumpy G-buffer with some background."""
    generator = torch.Generator().manual_seed(seed)
    depth = 8 + torch.rand(1, 1, height, width, generator=generator)
    rays = torch.rand(1, 2, height, width, generator=generator) - 0.5
    normal = torch.nn.functional.normalize(
        torch.randn(1, 3, height, width, generator=generator), dim=1
    )
    gbuffer = torch.cat([normal, rays * depth, -depth], 1)
    gbuffer[:, :, :9, :13] = 0
    return gbuffer


@pytest.mark.parametrize("effect", PAPER)
def test_the_papers_networks_have_the_published_number_of_parameters(effect: str) -> None:
    width, levels, inputs, outputs, published = PAPER[effect]
    config = NetworkConfig(
        kind="paper",
        inputs=inputs,
        outputs=outputs,
        widths=tuple(width * 2**n for n in range(levels)),
    )
    assert sum(p.numel() for p in build(config).parameters()) == published


@pytest.mark.parametrize("config", [SMALL, SMALL_PAPER, WIDE, DETAILED])
def test_a_pixel_beyond_the_halo_changes_nothing(config: NetworkConfig) -> None:
    model = awake(config)
    step, halo = model.size_multiple, model.halo
    side = -(-(2 * halo + 64) // step) * step
    first = scene(side, side)
    second = first.clone()
    middle = side // 2 + 3
    second[:, :, middle, middle] *= 1.5
    with torch.inference_mode():
        changed = (model(first) - model(second)).abs()[0, 0] > 0
    where = torch.nonzero(changed)
    assert len(where)
    reach = int((where - middle).abs().max())
    assert reach <= halo
    assert reach > halo // 2  # the bound isn't loose; float32 hides the faintest influence


@pytest.mark.parametrize("config", [SMALL, SMALL_PAPER, WIDE, DETAILED])
def test_needs_are_exactly_what_gradients_reach(config: NetworkConfig) -> None:
    """Weights are positive and no rectifier clips: every path counts, so the bound must be met.

    Except that of several points only the highest makes a horizon: over a few random scenes, any.
    """
    torch.manual_seed(0)
    model = build(config).double().train()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(torch.rand_like(parameter)) if name.endswith("weight") else None
    step, halo = model.size_multiple, model.halo
    side = 2 * step * -(-halo // step) + step
    for offset in (0, 1, step // 2, step - 1):
        column = side // 2 // step * step + offset
        reached = torch.zeros(side, dtype=torch.bool)
        for _ in range(1 if config.kind == "paper" else 12):
            gbuffer = 0.1 * torch.rand(1, 6, step, side, dtype=torch.float64)
            gbuffer[:, :3] += 1
            gbuffer[:, 5] -= 5
            gbuffer.requires_grad_()
            with torch.enable_grad():
                model(gbuffer)[0, 0, :, column].sum().backward()
            assert gbuffer.grad is not None
            reached |= gbuffer.grad.abs().sum((0, 1, 2)) > 0
        columns = torch.nonzero(reached)
        assert (int(columns.min()), int(columns.max())) == model.needs(column)


@pytest.mark.parametrize("config", [SMALL, SMALL_PAPER])
def test_tiles_with_a_halo_equal_the_whole(config: NetworkConfig) -> None:
    model = awake(config)
    step = model.size_multiple
    halo = -(-model.halo // step) * step
    side = 2 * halo + 4 * step
    whole_input = scene(side, side)
    with torch.inference_mode():
        whole = model(whole_input)
        tile = model(whole_input[:, :, step : step + 2 * halo + step, :])
    inner = tile[:, :, halo : halo + step]
    assert (inner - whole[:, :, step + halo : 2 * step + halo]).abs().max() < 1e-5


def leaking(fold: int, steps: tuple[int, ...], down: tuple[int, ...], up: tuple[int, ...]) -> Any:
    """A network whose background is held back by few masks only."""
    widths = (8,) * len(down)
    return NetworkConfig(
        widths=widths, steps=steps, down=down, up=up, fold=fold, rings=(1, 1), fine_rings=(1, 1)
    )


LEAKING = [
    leaking(8, (2,), (0, 2), (2,)),
    leaking(8, (2,), (0, 1), (3,)),
    leaking(4, (2, 2, 2), (0, 0, 2, 2), (3, 3, 0)),
]


@pytest.mark.parametrize("config", [SMALL, WIDE, DETAILED, *LEAKING])
def test_background_beyond_its_halo_changes_nothing(config: NetworkConfig) -> None:
    model = awake(config)
    step, margin = model.size_multiple, model.background_halo
    assert margin < model.halo
    side = 4 * step + 4 * margin
    whole = torch.zeros(1, 6, side, side)
    first, last = 2 * margin + step, side - 2 * margin - step
    # Ragged, with a hole, and touching the corners of its bounding box.
    patch = scene(last - first, last - first)
    patch[:, :, -3:, :5] = 0
    whole[:, :, first:last, first:last] = patch
    whole[:, :, first + 20 : first + 30, first + 15 : first + 40] = 0
    low, high = first - margin, last + margin
    assert low % step == 0
    with torch.inference_mode():
        cropped = model(whole[:, :, low:high, low:high])
        expected = model(whole)[:, :, low:high, low:high]
    assert float(expected.std()) > 1e-3
    assert (cropped - expected).abs().max() < 1e-5


@pytest.mark.parametrize("config", [SMALL, SMALL_PAPER])
def test_background_is_open(config: NetworkConfig) -> None:
    model = awake(config)
    gbuffer = scene(64, 64)
    with torch.inference_mode():
        image = model(gbuffer)
    assert (image[:, :, :9, :13] == 1).all()
    assert image.min() >= 0
    assert image.max() <= 1


@pytest.mark.parametrize("value", [0.0, 1e-20, 1e4, 1e18])
def test_extreme_positions_stay_finite(value: float) -> None:
    model = awake(SMALL)
    gbuffer = scene(64, 64)
    gbuffer[:, 3:] *= value
    with torch.inference_mode():
        assert torch.isfinite(model(gbuffer)).all()


def test_an_all_background_image_is_white() -> None:
    with torch.inference_mode():
        assert (awake(SMALL)(torch.zeros(1, 6, 64, 64)) == 1).all()


def test_far_translation_along_the_view_matters_little() -> None:
    """Offsets are relative: a distant surface differs from a near one by its R/z alone."""
    model = awake(SMALL)
    gbuffer = scene(64, 64)
    near, far = gbuffer.clone(), gbuffer.clone()
    covered = gbuffer[:, :3].abs().sum(1) > 0
    near[:, 5][covered] -= 1e3
    far[:, 5][covered] -= 2e3
    with torch.inference_mode():
        assert (model(near) - model(far)).abs().max() < 1e-2


def test_gradients_are_finite_on_background_and_degenerate_input() -> None:
    model = build(SMALL).train()
    gbuffer = scene(64, 64)
    gbuffer[:, 3:, 20:30] = 0
    model(gbuffer).square().mean().backward()
    for parameter in model.parameters():
        assert parameter.grad is None or np.isfinite(parameter.grad.numpy()).all()
