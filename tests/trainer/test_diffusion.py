"""Subsurface scattering's bases: against Burley's profile, and what light must not change."""

from __future__ import annotations

import math

import pytest
import torch

from deepshade_trainer.networks.bases.diffusion import Diffusion

FOCAL = 300.0  # pixels


def _plane(height: int, width: int, path: float, tilt: float = 0.0) -> torch.Tensor:
    """A plane at depth 1 in the middle, mean free paths of `path` pixels there, random light."""
    torch.manual_seed(0)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    x, y = (x - width / 2) / FOCAL, (height / 2 - y) / FOCAL
    depth = 1 / (1 - tilt * x)
    position = torch.stack([x * depth, y * depth, -depth])
    scatter = torch.full((3, height, width), path / FOCAL)
    return torch.cat([position, scatter, torch.rand(3, height, width)])[None]


def _shade(gbuffer: torch.Tensor, weights: torch.Tensor | None = None) -> torch.Tensor:
    bases = Diffusion()
    told, state = bases.features(gbuffer)
    assert told.shape[1] == bases.told
    assert told.isfinite().all() and told.abs().max() < 4
    if weights is None:
        weights = torch.zeros(1, bases.weights, *gbuffer.shape[2:])
    return bases.carry(state, weights)


@pytest.mark.parametrize("path", [0.5, 2.0, 8.0])
def test_light_spreads_by_burleys_profile(path: float) -> None:
    gbuffer = _plane(256, 256, path)
    gbuffer[:, 6:] = 0
    gbuffer[:, 6:, 127:129, 127:129] = 0.25
    image = _shade(gbuffer)[0, 0]
    y, x = torch.meshgrid(torch.arange(256) - 127.5, torch.arange(256) - 127.5, indexing="ij")
    distance = (x * x + y * y).sqrt()
    for radius in (2 * path, 4 * path, 8 * path):
        if radius < 1.5:
            continue
        within = 1 - 0.25 * math.exp(-radius / path) - 0.75 * math.exp(-radius / 3 / path)
        assert float(image[distance < radius].sum()) == pytest.approx(within, abs=0.08)


def test_constant_light_stays_whatever_the_weights() -> None:
    gbuffer = _plane(128, 128, 8.0, tilt=1.0)
    gbuffer[:, :3, :40] = 0  # background
    gbuffer[:, 3:4, 50:60] = 0  # no scattering in red
    gbuffer[:, 6:] = 3.0
    image = _shade(gbuffer, torch.randn(1, 3, 128, 128))
    assert (image - 3).abs().max() < 1e-4


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_the_answer_scales_with_the_light(scale: float) -> None:
    gbuffer = _plane(128, 128, 4.0)
    lit = gbuffer.clone()
    lit[:, 6:] *= scale
    torch.testing.assert_close(_shade(lit), _shade(gbuffer) * scale, rtol=1e-4, atol=0)


def test_without_scattering_or_surface_light_stays() -> None:
    gbuffer = _plane(128, 128, 0.0)
    assert torch.equal(_shade(gbuffer), gbuffer[:, 6:])
    gbuffer[:, :6] = 0
    assert torch.equal(_shade(gbuffer), gbuffer[:, 6:])
    assert torch.equal(_shade(torch.zeros(1, 9, 128, 128)), torch.zeros(1, 3, 128, 128))


def _exact(gbuffer: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """The profile summed over all pixels that scatter, by their areas: planes that face the eye."""
    place, path, light = gbuffer[0, :3].flatten(1), gbuffer[0, 3].flatten(), gbuffer[0, 6].flatten()
    area = (place[2] / FOCAL) ** 2
    found = []
    for here in (rows * gbuffer.shape[3] + columns).tolist():
        r, d = (place - place[:, here : here + 1]).norm(dim=0), path[here]
        r[here] = 1
        share = (torch.exp(-r / d) + torch.exp(-r / 3 / d)) / (8 * math.pi * d * r) * area
        own = (area[here] / math.pi).sqrt() / d  # a disc as large as the pixel
        share[here] = 1 - 0.25 * torch.exp(-own) - 0.75 * torch.exp(-own / 3)
        share = share * (path > 0)
        found.append((share * light).sum() / share.sum())
    return torch.stack(found)


@pytest.mark.parametrize("path", [2.0, 4.0, 8.0, 16.0])
def test_bars_before_a_wall_that_scatter_nothing_do_not_blur_into_it(path: float) -> None:
    gbuffer = _plane(256, 256, path)
    gbuffer[:, 6:] = torch.linspace(0, 1, 256) ** 2
    gbuffer[:, 6:, :, 100:] = 0
    bars = torch.arange(256) % 8 < 4
    gbuffer[:, :3, :, bars] *= 0.5
    gbuffer[:, 3:6, :, bars], gbuffer[:, 6:, :, bars] = 0, 0.2
    rows, columns = torch.randint(60, 200, (150,)), torch.randint(60, 140, (150,))
    rows, columns = rows[~bars[columns]], columns[~bars[columns]]
    away = _shade(gbuffer)[0, 0, rows, columns] - _exact(gbuffer, rows, columns)
    assert away.abs().mean() < 0.006 and away.abs().max() < 0.03


def test_light_stays_on_its_side_of_a_gap_in_depth() -> None:
    gbuffer = _plane(128, 128, 4.0)
    gbuffer[:, :3, :, 64:] *= 3  # the right half is far behind
    gbuffer[:, 6:, :, :64], gbuffer[:, 6:, :, 64:] = 1.0, 0.0
    image = _shade(gbuffer)[0, 0]
    assert image[:, :60].min() > 0.95
    assert image[:, 68:].max() < 0.05


def test_a_firefly_changes_only_what_it_lights() -> None:
    gbuffer = _plane(128, 256, 1.0)
    calm = _shade(gbuffer)
    gbuffer[:, 6:, 64, 20] = 1e5
    gbuffer[:, 3:6, :, 128:] = 0
    assert torch.equal(_shade(gbuffer)[..., 128:], gbuffer[:, 6:, :, 128:])
    gbuffer[:, 3:6, :, 19:22] = 0  # nor does it light anything where it doesn't scatter
    image = _shade(gbuffer)
    assert image.isfinite().all()
    torch.testing.assert_close(image[..., 40:100], calm[..., 40:100], rtol=0.02, atol=0.02)


@pytest.mark.slow
def test_tiles_equal_the_whole() -> None:
    gbuffer = _plane(128, 128 * 18, 30.0)
    bases = Diffusion()
    first, last = bases.receptive_field(128 * 9)[0], bases.receptive_field(128 * 10 - 1)[1]
    size = bases.size_multiple
    start = max(0, first // size * size)
    stop = min(128 * 18, (last // size + 1) * size)
    assert start > 0 and stop < 128 * 18
    whole = _shade(gbuffer)[..., 128 * 9 : 128 * 10]
    tile = _shade(gbuffer[..., start:stop])[..., 128 * 9 - start : 128 * 10 - start]
    torch.testing.assert_close(tile, whole, rtol=0, atol=1e-5)
