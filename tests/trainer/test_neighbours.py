"""Blends of neighbours, against closed forms and what must hold for any input."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks import build
from deepshade_trainer.networks.bases.neighbours import _AROUND, _START, Neighbours
from deepshade_trainer.recipe import preset

SKY, DARK = 1e3, 1e-2


def _random(height: int = 48, width: int = 64) -> Tensor:
    """Blocks of light and depth; the top is background."""
    torch.manual_seed(0)
    blocks = torch.rand(1, 4, height // 8, width // 8) + 0.01
    gbuffer = F.interpolate(blocks, scale_factor=8.0) + 0.01 * torch.rand(1, 4, height, width)
    gbuffer[:, 0, :8] = 0
    return gbuffer


def _blended(gbuffer: Tensor, shares: Tensor) -> Tensor:
    """What `carry` makes of shares (N, 4, H, W) of the neighbours, which sum to less than 1."""
    bases = Neighbours()
    weights = torch.log(shares / (1 - shares.sum(1, keepdim=True))) - _START
    return bases.carry(bases.features(gbuffer)[1], weights)


def _network() -> torch.nn.Module:
    """The preset's network, with weights that all do something."""
    torch.manual_seed(0)
    model = build(preset("balanced", "aa").network)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return model.eval()


@pytest.mark.parametrize("dark_above", [True, False])
def test_a_bright_sky_behind_a_dark_edge_gives_its_coverage(dark_above: bool) -> None:
    """An edge that falls by 1 pixel in 16: rows along it see the sky between, 0 to 1."""
    gbuffer = torch.zeros(1, 4, 8, 16)
    ground = gbuffer[:, :, :4] if dark_above else gbuffer[:, :, 4:]
    gbuffer[:, 1:] = SKY
    ground[:, 0], ground[:, 1:] = 2.0, DARK
    coverage = (torch.arange(16) + 0.5) / 16 * 0.98
    shares = torch.full((1, 4, 8, 16), 1e-12)
    row, down = (3, 1) if dark_above else (4, -1)
    shares[:, _AROUND.index((down, 0)), row] = coverage
    image = _blended(gbuffer, shares)
    expected = DARK + coverage * (SKY - DARK)
    torch.testing.assert_close(image[0, 0, row], expected, rtol=1e-4, atol=0)
    others = [k for k in range(8) if k != row]
    torch.testing.assert_close(image[:, :, others], gbuffer[:, 1:, others], rtol=1e-4, atol=0)


@pytest.mark.parametrize("direction", range(4))
def test_a_weight_moves_light_from_its_own_neighbour(direction: int) -> None:
    gbuffer = _random()
    shares = torch.full((1, 4, 48, 64), 1e-9)
    shares[:, direction] = 1 - 1e-4
    down, right = _AROUND[direction]
    moved = torch.roll(gbuffer[:, 1:], (-down, -right), (2, 3))
    inner = (..., slice(1, -1), slice(1, -1))
    found = _blended(gbuffer, shares)
    torch.testing.assert_close(found[inner], moved[inner], atol=1e-3, rtol=0)


def test_an_answer_lies_between_a_pixel_and_its_neighbours() -> None:
    """Whatever the weights: no edge gets a halo, dark or bright."""
    gbuffer = _random()
    gbuffer[:, 1:, :8] = SKY
    with torch.inference_mode():
        image = _network()(gbuffer)
    light = gbuffer[:, 1:]
    wide = F.pad(light, (1, 1, 1, 1), mode="replicate")
    around = torch.stack([light, *(wide[:, :, 1 + d : 49 + d, 1 + r : 65 + r] for d, r in _AROUND)])
    assert (image >= around.amin(0) * (1 - 1e-5)).all()
    assert (image <= around.amax(0) * (1 + 1e-5)).all()
    assert (image - light).abs().max() > 1e-3


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_exposure_and_size_change_nothing(scale: float) -> None:
    gbuffer = _random()
    other = gbuffer.clone()
    other[:, :1] *= 7
    other[:, 1:] *= scale
    with torch.inference_mode():
        model = _network()
        torch.testing.assert_close(model(other), model(gbuffer) * scale, rtol=1e-3, atol=0)


def test_a_firefly_lights_only_itself_and_its_neighbours() -> None:
    """Around it the network may see an edge, and blend differently, but not out of bounds."""
    gbuffer = _random()
    bright = gbuffer.clone()
    bright[:, 1:, 24, 32] = 1e5
    with torch.inference_mode():
        image = _network()(bright)
    lit = (image > 2).any(1)[0]
    rows, columns = lit.nonzero(as_tuple=True)
    assert len(rows)
    assert ((rows - 24).abs() + (columns - 32).abs()).max() <= 1


def test_edges_are_told_as_ratios() -> None:
    gbuffer = torch.ones(1, 4, 1, 2)
    gbuffer[:, :, :, 1] = 3
    told, _ = Neighbours().features(gbuffer)
    light, nearness = -0.5, 0.5  # (1 - 3) / (1 + 3), and of 1 / depth
    expected = torch.tensor([light] * 3 + [nearness] + [0.0] * 4)
    torch.testing.assert_close(told[0, :, 0, 0], expected)
    assert (told[..., 1] == 0).all()  # beyond the picture's edge is what is in it


@pytest.mark.parametrize("value", [0.0, 1e5, -1e5, 1e30])
def test_odd_cases_stay_finite(value: float) -> None:
    gbuffer = torch.full((1, 4, 4, 4), value)
    gbuffer[:, :, 1, 1] = 0
    bases = Neighbours()
    told, state = bases.features(gbuffer)
    assert told.abs().max() <= 1
    for weight in (-math.inf, -1e3, 1e3, math.inf):
        image = bases.carry(state, torch.full((1, 4, 4, 4), weight))
        assert image.isfinite().all()


def test_tiles_equal_the_whole() -> None:
    gbuffer = torch.cat([_random(), _random().flip(-1)], 3)
    model = _network()
    step = model.size_multiple
    first = 64
    begin = max(0, model.receptive_field(first)[0] // step * step)
    end = -(-(model.receptive_field(first + 7)[1] + 1) // step) * step
    with torch.inference_mode():
        whole, tile = model(gbuffer), model(gbuffer[..., begin:end])
    inside = slice(first - begin, first - begin + 8)
    torch.testing.assert_close(tile[..., inside], whole[..., first : first + 8], atol=1e-5, rtol=0)
