"""Edges: planes have none, steps in closed form, what is too far off, background."""

from __future__ import annotations

import math

import pytest
import torch

from deepshade_trainer.networks.edges import edges, second_differences

SIDE, SIZE = 16, 2
PIXEL = 2 * math.tan(math.radians(25)) / 512  # of 50 degrees, at depth 1


def plane(normal: tuple[float, float, float], distance: float) -> torch.Tensor:
    """Depths (1, 1, SIDE, SIDE) of the plane normal · p = -distance, negative, in perspective."""
    row, column = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    ray = PIXEL * (column + 9.5), -PIXEL * (row + 30.5), -1
    return -distance / sum(n * r for n, r in zip(normal, ray, strict=True)).neg()[None, None]


def found(z: torch.Tensor) -> torch.Tensor:
    """`edges` by pixel, (2, SIDE, SIDE): along rows and columns; without the picture's border."""
    cells = edges(z, SIZE, second_differences(SIZE).to(z.dtype))
    by_pixel = cells.reshape(SIZE, SIZE, 2, SIDE // SIZE, SIDE // SIZE).permute(2, 3, 0, 4, 1)
    return by_pixel.reshape(2, SIDE, SIDE)[:, 1:-1, 1:-1]


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.6, 0, 0.8), (0.3, -0.9, 0.3), (-0.99, 0, 0.14)])
@pytest.mark.parametrize("distance", [0.01, 1.0, 1e3])
def test_a_plane_has_no_edges_whatever_its_slope(
    normal: tuple[float, float, float], distance: float
) -> None:
    assert found(plane(normal, distance)).abs().max() < 1e-3


def test_a_step_shows_on_both_its_sides_and_along_its_axis_alone() -> None:
    z = plane((0, 0, 1), 2.0)
    z[..., 8:] *= 1.004  # the right half is 0.4 % farther
    along, down = found(z)
    told = 1.0 / math.sqrt(2)  # a step of 1/250
    assert along[:, 6].min() == pytest.approx(-told, abs=0.01)  # near: its neighbour is far
    assert along[:, 7].max() == pytest.approx(told, abs=0.01)  # far: its neighbour is near
    assert along[:, :6].abs().max() < 1e-3
    assert along[:, 8:].abs().max() < 1e-3
    assert down.abs().max() < 1e-3


def test_a_corner_is_hollow_and_a_ridge_is_not() -> None:
    flat, across = plane((0, 0, 1), 3.0), 3 * PIXEL * 17.5
    wall = plane((-0.8, 0, 0.6), 0.8 * across + 0.6 * 3)  # it meets the other in the middle
    assert found(torch.maximum(flat, wall))[0].max() > 0.1
    assert found(torch.maximum(flat, wall))[0].min() > -1e-3
    assert found(torch.minimum(flat, wall))[0].min() < -0.1
    assert found(torch.minimum(flat, wall))[0].max() < 1e-3


@pytest.mark.parametrize(("behind", "shown"), [(0.4, True), (1.7, False), (50.0, False)])
def test_what_is_farther_behind_than_the_radius_is_no_edge(behind: float, shown: bool) -> None:
    """As with horizons: a wall 1.6 radii behind a bar isn't occluded by it."""
    z = plane((0, 0, 1), 100.0)
    z[..., 8:] -= behind
    assert (found(z)[0].max() > 0.5) == shown


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e18, 1e30])
def test_background_and_extremes_stay_finite(scale: float) -> None:
    z = plane((0.3, 0, 0.9), 1.0) * scale
    z[..., 6:9, 3:11] = 0
    told = edges(z, SIZE, second_differences(SIZE))
    assert torch.isfinite(told).all()
    assert told.abs().max() <= 1
    assert (edges(torch.zeros_like(z), SIZE, second_differences(SIZE)) == 0).all()
