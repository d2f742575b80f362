"""Enlarging against bilinear interpolation."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from deepshade_trainer.networks.enlarging import Twice


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (7, 4)])
def test_it_is_bilinear_up_to_the_borders(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    planes = torch.rand(2, 3, *size) * 1e5
    exact = F.interpolate(planes, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(Twice(3)(planes), exact)
