"""Cells of pixels: enlarged as PyTorch does on a plane, and kept apart where surfaces end."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from deepshade_trainer.networks.bases.cells import enlarged, smoothed
from deepshade_trainer.networks.horizons import sampled

SIDE, HEIGHT, WIDTH = 4, 32, 48


def _facing(depth: Tensor) -> Tensor:
    """(1, 6, H, W): surfaces that face the eye at these depths (H, W), seen along parallel rays."""
    rows, columns = torch.meshgrid(
        torch.arange(HEIGHT) * 0.01, torch.arange(WIDTH) * 0.01, indexing="ij"
    )
    normal = torch.zeros(3, HEIGHT, WIDTH)
    normal[2] = 1
    return torch.cat([normal, torch.stack([columns, -rows, -depth])])[None]


def _halves() -> Tensor:
    """A step from depth 1 to 3 at a column that lies inside a cell."""
    return torch.where(torch.arange(WIDTH) < 22, 1.0, 3.0).expand(HEIGHT, WIDTH)


def test_on_a_plane_cells_are_enlarged_bilinearly() -> None:
    torch.manual_seed(0)
    pixels = _facing(torch.full((HEIGHT, WIDTH), 2.0))
    cells = torch.rand(1, 5, HEIGHT // SIDE, WIDTH // SIDE)
    found = enlarged(cells, sampled(pixels, SIDE), pixels, SIDE)
    wanted = F.interpolate(cells, scale_factor=float(SIDE), mode="bilinear", align_corners=False)
    inside = slice(SIDE, -SIDE)  # beyond the edge PyTorch repeats cells, and here there are none
    torch.testing.assert_close(
        found[..., inside, inside], wanted[..., inside, inside], atol=1e-3, rtol=0
    )


def test_a_pixel_takes_from_its_own_surface() -> None:
    pixels = _facing(_halves())
    surface = sampled(pixels, SIDE)
    light = (surface[:, 5:] < -2).float()  # far cells shine
    found = enlarged(light, surface, pixels, SIDE)
    assert (found - (pixels[:, 5:] < -2).float()).abs().max() < 0.05
    plain = F.interpolate(light, scale_factor=float(SIDE), mode="bilinear", align_corners=False)
    assert (plain - (pixels[:, 5:] < -2).float()).abs().max() > 0.5


def test_where_no_cell_has_a_surface_what_is_around_is_taken() -> None:
    pixels = _facing(torch.full((HEIGHT, WIDTH), 2.0))
    surface = sampled(pixels, SIDE)
    surface[..., 6:] = 0
    cells = smoothed(torch.ones(1, 1, *surface.shape[2:]), *torch.split(surface, 3, 1))
    found = enlarged(cells, surface, pixels, SIDE)
    torch.testing.assert_close(found[..., : 7 * SIDE - 2], torch.ones(1, 1, HEIGHT, 7 * SIDE - 2))


def test_all_that_surrounds_a_cell_counts_alike_whatever_the_scale() -> None:
    pixels = _facing(_halves())
    cells = torch.rand(1, 2, HEIGHT // SIDE, WIDTH // SIDE)
    found = enlarged(cells, sampled(pixels, SIDE), pixels, SIDE)
    far = torch.cat([pixels[:, :3], pixels[:, 3:] * 64], 1)
    torch.testing.assert_close(enlarged(cells, sampled(far, SIDE), far, SIDE), found)
