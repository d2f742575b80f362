"""Light over discs, against what a lens does to points and edges, and what holds for any input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from deepshade_trainer.networks.discs import Discs


def _shaded(gbuffer: Tensor) -> Tensor:
    found: Tensor = Discs()(gbuffer)
    return found


def _random(height: int = 96, width: int = 96) -> Tensor:
    """A near square and a far half about something in focus."""
    torch.manual_seed(0)
    gbuffer = torch.rand(1, 4, height, width)
    gbuffer[:, 0, :, : width // 2] *= 20
    gbuffer[:, 0, height // 3 : height // 2, width // 3 : width // 2] = -15
    return gbuffer


def _halves(left: tuple[float, float], right: tuple[float, float], width: int = 128) -> Tensor:
    """Two halves, each of (focal, light)."""
    gbuffer = torch.zeros(1, 4, 64, width)
    for columns, (focal, light) in ((slice(0, width // 2), left), (slice(width // 2, None), right)):
        gbuffer[:, 0, :, columns], gbuffer[:, 1:, :, columns] = focal, light
    return gbuffer


def test_what_is_in_focus_stays_as_it_is() -> None:
    gbuffer = _random()
    gbuffer[:, 0] = 0
    assert (_shaded(gbuffer) - gbuffer[:, 1:]).abs().max() < 1e-6


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_linear_in_light(scale: float) -> None:
    gbuffer = _random()
    brighter = gbuffer.clone()
    brighter[:, 1:] *= scale
    torch.testing.assert_close(_shaded(brighter), _shaded(gbuffer) * scale, rtol=1e-4, atol=0)


def test_constant_light_is_kept() -> None:
    gbuffer = _random()
    gbuffer[:, 1:] = 0.7
    torch.testing.assert_close(_shaded(gbuffer), gbuffer[:, 1:], rtol=1e-4, atol=0)


@pytest.mark.parametrize("radius", [2.0, 3.0, 4.0, 4.5, 9.0, 12.0, 20.0])
@pytest.mark.parametrize("side", [1, -1])
def test_a_point_spreads_over_its_circle_and_keeps_its_energy(side: int, radius: float) -> None:
    gbuffer = torch.zeros(1, 4, 96, 96)
    gbuffer[:, 0], gbuffer[:, 1:, 48, 48] = side * 2 * radius, 1000.0
    image = _shaded(gbuffer)[0, 0]
    place = torch.arange(96) - 48
    square = place[:, None] ** 2 + place**2
    assert image.sum() == pytest.approx(1000, rel=0.01)
    # the second moment of a disc is half of its radius squared
    assert (image * square).sum() / 1000 == pytest.approx(radius**2 / 2, rel=0.15)


@pytest.mark.parametrize(("dark", "bright"), [(0.0, 100.0), (100.0, 0.0)])
@pytest.mark.parametrize("blur", [3.0, 8.0, 24.0, 40.0])
def test_an_object_in_focus_has_clean_edges_before_a_sky(
    dark: float, bright: float, blur: float
) -> None:
    """Every ray through a sky pixel passes the object: both stay as they are, up to the edge."""
    gbuffer = _halves((0.0, dark), (blur, bright))
    assert (_shaded(gbuffer) - gbuffer[:, 1:]).abs().max() < 1


@pytest.mark.parametrize("focal", [-1.0, -0.3, 0.3, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("blur", [16.0, 48.0])
def test_no_sky_shines_through_what_is_almost_in_focus(focal: float, blur: float) -> None:
    """Two pixels inside the edge of a wall its own circles are all that reach."""
    image = _shaded(_halves((focal, 1.0), (blur, 1e4)))[0, 0, 32]
    inside = len(image) // 2 - 3
    assert image[:inside] == pytest.approx(np.ones(inside), abs=0.1)


@pytest.mark.parametrize(("dark", "bright"), [(0.0, 100.0), (100.0, 0.0)])
@pytest.mark.parametrize("blur", [8.0, 24.0, 40.0])
@pytest.mark.parametrize("sky", [0.0, 12.0])
def test_an_object_before_the_focus_covers_its_share_of_a_sky(
    dark: float, bright: float, blur: float, sky: float
) -> None:
    """The share of a circle beyond a line; the sky that the object hides is continued."""
    image = _shaded(_halves((-blur, dark), (sky, bright)))[0, 0, 24:40, 16:-16].mean(0)
    d = ((torch.arange(128) - 63.5) / (blur / 2)).clamp(-1, 1)[16:-16]
    share = (torch.arccos(d) - d * (1 - d * d).sqrt()) / torch.pi
    away = (image - (dark * share + bright * (1 - share))).abs()
    assert away.mean() < 2 and away.max() < 20
    steps = image.diff() * (1 if bright > dark else -1)
    assert steps.min() > -8  # no halo: it rises towards the brighter alone


def test_a_firefly_changes_only_its_circle() -> None:
    gbuffer = torch.rand(1, 4, 96, 96)
    gbuffer[:, 0] = 16.0
    bright = gbuffer.clone()
    bright[:, 1:, 48, 48] = 1e5
    changed = (_shaded(bright) - _shaded(gbuffer)).abs().amax((0, 1)) > 1e-4
    rows, columns = changed.nonzero(as_tuple=True)
    for places in (rows, columns):
        assert places.min() >= 48 - 24 and places.max() <= 48 + 24


@pytest.mark.parametrize("side", [4, 32])
def test_odd_cases_stay_finite(side: int) -> None:
    for value in (0.0, 1e5, -1e5):
        gbuffer = torch.full((1, 4, side, side), value)
        assert _shaded(gbuffer).isfinite().all()


def test_tiles_equal_the_whole() -> None:
    gbuffer = _random(160, 160)
    bases = Discs()
    first, last = 64, 79
    begin = max(0, bases.receptive_field(first)[0] // 4 * 4)
    end = min(160, (bases.receptive_field(last)[1] + 4) // 4 * 4)
    assert begin > 0 and end < 160
    tile = _shaded(gbuffer[:, :, begin:end, begin:end])
    inside = slice(first - begin, last + 1 - begin)
    whole = _shaded(gbuffer)[:, :, first : last + 1, first : last + 1]
    torch.testing.assert_close(tile[:, :, inside, inside], whole, atol=1e-5, rtol=1e-5)
