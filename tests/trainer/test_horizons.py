"""Horizons: closed forms, fading, and what must not count."""

from __future__ import annotations

import math

import pytest
import torch

from deepshade_trainer.networks.horizons import directions, horizons, sampled, unit

# Of `horizons`: right, down, left, up, then the diagonals.
RIGHT, DOWN, LEFT, UP = range(4)


def ground(side: int = 9, spacing: float = 0.01) -> torch.Tensor:
    """A plane that faces the camera at depth 5: unit normals, positions, coverage."""
    row, column = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    zero, one = torch.zeros(side, side), torch.ones(side, side)
    x, y = spacing * (column - side // 2), spacing * (side // 2 - row)
    return torch.stack([zero, zero, one, x, y, -5 * one, one])[None]


def test_a_plane_has_no_horizon() -> None:
    assert horizons(ground(), (1, 1, 3, 2)).max() == 0


@pytest.mark.parametrize("turned", [0.3, 1.0])
def test_a_tilted_plane_has_none_either(turned: float) -> None:
    cells = ground()
    cells[:, 0], cells[:, 2] = math.sin(turned), math.cos(turned)
    cells[:, 5] -= cells[:, 3] * math.tan(turned)
    assert horizons(cells, (1, 1, 3, 2)).max() < 1e-4


@pytest.mark.parametrize("elevation", [0.2, 0.8, 1.4])
def test_a_slope_is_seen_at_its_elevation(elevation: float) -> None:
    """Ground up to the middle, and right of it a ramp: the sine of its angle, nearby in full."""
    cells = ground()
    rise = cells[:, 3].clamp_min(0) * math.tan(elevation)
    cells[:, 5] += rise
    found = horizons(cells, (1, 1))[0, :, 4, 4]
    assert found[RIGHT] == pytest.approx(math.sin(elevation), abs=1e-4)
    assert found[[DOWN, LEFT, UP]].max() == 0
    diagonal = math.atan(math.tan(elevation) / math.sqrt(2))
    assert sorted(found[4:].tolist())[2:] == pytest.approx([math.sin(diagonal)] * 2, abs=1e-4)


def test_the_highest_ring_counts_in_its_turn() -> None:
    cells = ground()
    cells[:, 5, :, 6] += 0.05  # a wall two cells to the right of the middle
    assert horizons(cells, (1, 1))[0, RIGHT, 4, 4] == 0
    assert horizons(cells, (1, 1, 2, 1))[0, RIGHT, 4, 4] == pytest.approx(
        0.05 / math.hypot(0.05, 0.02), abs=1e-4
    )
    assert horizons(cells, (1, 2))[0, RIGHT, 4, 4] == 0  # 2 is the diagonals' turn


@pytest.mark.parametrize("rings", [(1,), (1, 2), (2, 1, 3), (1, 1, 2, 2, 20)])
def test_neighbours_together_or_one_by_one(rings: tuple[int, ...]) -> None:
    """The same to the last bit; rings may be wider than the picture."""
    cells = ground(12)
    cells[:, 5] += 0.05 * torch.rand(1, 12, 12, generator=torch.Generator().manual_seed(1))
    cells[:, :, 3:5, 2:7] = 0
    one, all_ = horizons(cells, rings), horizons(cells, rings, together=True)
    assert one.shape[1] == directions(rings)
    assert one.max() > 0
    assert torch.equal(one, all_)


@pytest.mark.parametrize(("distance", "weight"), [(0.4, 1.0), (1.6, 0.0), (100.0, 0.0)])
def test_it_fades_with_distance(distance: float, weight: float) -> None:
    cells = ground()
    cells[:, 5, 4, 5] += distance
    found = horizons(cells, (1, 1))[0, RIGHT, 4, 4]
    assert found == pytest.approx(weight, abs=1e-3)


def test_background_neither_occludes_nor_is_occluded() -> None:
    cells = ground()
    cells[:, 5, :, 5:] += 0.05
    cells[:, :, :, 5:] *= 0  # as background is
    assert horizons(cells, (1, 1, 2, 2)).max() == 0


def test_huge_positions_stay_finite() -> None:
    cells = ground()
    cells[:, 3:6] *= 1e18
    assert torch.isfinite(horizons(cells, (1, 1, 2, 2))).all()


def test_it_turns_with_the_picture() -> None:
    """A quarter turn of a random scene turns the directions: right becomes up, and so on."""
    generator = torch.Generator().manual_seed(0)
    cells = ground(12)
    cells[:, 5] += 0.05 * torch.rand(1, 12, 12, generator=generator)
    there = horizons(cells, (1, 1, 2, 3))
    turned = torch.rot90(cells, 1, (2, 3)).clone()
    turned[:, 3], turned[:, 4] = -turned[:, 4].clone(), turned[:, 3].clone()
    back = torch.rot90(horizons(turned, (1, 1, 2, 3)), -1, (2, 3))
    assert torch.allclose(back[:, [UP, RIGHT, DOWN, LEFT]], there[:, :4], atol=1e-5)
    assert torch.allclose(back.sum(1), there.sum(1), atol=1e-5)


def test_sampling_takes_the_middle_pixel() -> None:
    x = torch.arange(64.0).reshape(1, 1, 8, 8)
    assert sampled(x, 4)[0, 0].tolist() == [[18, 22], [50, 54]]
    assert sampled(x, 1) is not None
    assert torch.equal(sampled(x, 1), x)


def test_unit_vectors() -> None:
    vectors = torch.randn(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    vectors[0, :, 0, 0] = 0
    found = unit(vectors)
    assert torch.allclose(found[1], torch.nn.functional.normalize(vectors[1], dim=0), atol=1e-5)
    assert found[0, :, 0, 0].abs().max() == 0
