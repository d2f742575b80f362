"""Light along lines of motion, against closed forms and what must hold for any input."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from deepshade_trainer.networks.bases.lines import Lines


def _shaded(gbuffer: Tensor) -> Tensor:
    bases = Lines()
    told, state = bases.features(gbuffer)
    return bases.carry(state, torch.zeros(len(gbuffer), bases.weights, *told.shape[2:]))


def _random(height: int = 96, width: int = 96) -> Tensor:
    """A square that moves over something else that moves less; the top is background."""
    torch.manual_seed(0)
    gbuffer = torch.rand(1, 6, height, width)
    gbuffer[:, 0], gbuffer[:, 1], gbuffer[:, 5] = 3.0, -2.0, 2.0
    square = gbuffer[:, :, height // 3 : height // 2, width // 3 : width // 2]
    square[:, 0], square[:, 1], square[:, 5] = -20.0, 12.0, 1.0
    top = gbuffer[:, :, : height // 4]
    top[:, :2], top[:, 5] = 0.0, 0.0
    return gbuffer


def test_what_rests_stays_as_it_is() -> None:
    gbuffer = _random()
    gbuffer[:, :2] = 0
    torch.testing.assert_close(_shaded(gbuffer), gbuffer[:, 2:5], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1e5])
def test_linear_in_light(scale: float) -> None:
    gbuffer = _random()
    brighter = gbuffer.clone()
    brighter[:, 2:5] *= scale
    torch.testing.assert_close(_shaded(brighter), _shaded(gbuffer) * scale, rtol=1e-4, atol=0)


def test_constant_light_is_kept() -> None:
    gbuffer = _random()
    gbuffer[:, 2:5] = 0.7
    torch.testing.assert_close(_shaded(gbuffer), gbuffer[:, 2:5], rtol=1e-4, atol=0)


def test_both_senses_of_a_motion_give_the_same_picture() -> None:
    gbuffer = _random()
    reversed_ = gbuffer.clone()
    reversed_[:, :2] *= -1
    torch.testing.assert_close(_shaded(reversed_), _shaded(gbuffer), rtol=1e-4, atol=1e-5)


def _turned(degrees: float) -> Tensor:
    """What a network is told of a scene whose motion points there."""
    gbuffer = torch.ones(1, 6, 32, 32)
    angle = torch.deg2rad(torch.tensor(degrees))
    gbuffer[:, 0], gbuffer[:, 1] = 12 * torch.cos(angle), 12 * torch.sin(angle)
    return Lines().features(gbuffer)[0]


@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0])
def test_told_of_directions_without_a_seam(degrees: float) -> None:
    """Half a degree to either side is told alike: also at 180, where an angle would jump."""
    assert (_turned(degrees - 0.5) - _turned(degrees + 0.5)).abs().max() < 0.03


def test_told_of_rest_without_a_direction() -> None:
    told = []
    for u, v in ((0.0, 0.0), (1e-3, 0.0), (-1e-3, 0.0), (0.0, 1e-3), (0.0, -1e-3)):
        gbuffer = torch.ones(1, 6, 32, 32)
        gbuffer[:, 0], gbuffer[:, 1] = u, v
        told.append(Lines().features(gbuffer)[0])
    for each in told[1:]:
        torch.testing.assert_close(each, told[0], atol=1e-3, rtol=0)


@pytest.mark.parametrize("near", [True, False])
def test_a_moving_half_covers_a_ramp(near: bool) -> None:
    """White moves 16 pixels over black that rests; or under it, and is not seen there."""
    gbuffer = torch.zeros(1, 6, 32, 96)
    gbuffer[:, 5] = 4.0
    moving = gbuffer[..., :48]
    moving[:, 0], moving[:, 2:5], moving[:, 5] = 16.0, 1.0, 1.0 if near else 9.0
    shaded = _shaded(gbuffer)[0, 0, 16]
    centres = torch.arange(96) + 0.5
    ramp = ((48 + 8 - centres) / 16).clamp(0, 1)
    if not near:
        # only white moves where white is: what it leaves is white that came from farther away
        ramp = (centres < 48).float()
        shaded, ramp = shaded[48:], ramp[48:]
    assert (shaded - ramp).abs().max() < 0.13  # a moment is 1/8


def test_stripes_that_move_fade_though_moments_fall_on_each_alike() -> None:
    """Stripes of 4 pixels move 32: eight moments at every pixel would keep them as they are."""
    gbuffer = torch.zeros(1, 6, 32, 128)
    gbuffer[:, 0], gbuffer[:, 5] = 32.0, 1.0
    gbuffer[..., 2:5, :, :] = (torch.arange(128) % 4 < 2).float()
    shaded = _shaded(gbuffer)[0, :, :, 32:96]
    assert (shaded - 0.5).abs().max() < 0.26


def test_a_firefly_changes_only_its_line() -> None:
    gbuffer = torch.rand(1, 6, 64, 96)
    gbuffer[:, 0], gbuffer[:, 1], gbuffer[:, 5] = 20.0, 0.0, 1.0
    bright = gbuffer.clone()
    bright[:, 2:5, 32, 48] = 1e5
    changed = (_shaded(bright) - _shaded(gbuffer)).abs().amax((0, 1)) > 1e-5
    rows, columns = changed.nonzero(as_tuple=True)
    assert rows.min() >= 32 - 1 and rows.max() <= 32 + 1
    assert columns.min() >= 48 - 11 and columns.max() <= 48 + 11


@pytest.mark.parametrize("side", [16, 32])
def test_odd_cases_stay_finite(side: int) -> None:
    for gbuffer in (
        torch.zeros(1, 6, side, side),
        torch.full((1, 6, side, side), 1e5),
        torch.full((1, 6, side, side), -1e5),
    ):
        told, _ = Lines().features(gbuffer)
        assert told.shape[1] == Lines.told
        assert told.abs().max() < 8
        assert _shaded(gbuffer).isfinite().all()


def test_tiles_equal_the_whole() -> None:
    gbuffer = _random(128, 128)
    bases = Lines()
    whole = _shaded(gbuffer)
    first, last = 64, 79
    begin = max(0, bases.receptive_field(first)[0] // 16 * 16)
    end = min(128, (bases.receptive_field(last)[1] + 16) // 16 * 16)
    tile = _shaded(gbuffer[:, :, begin:end, begin:end])
    inside = slice(first - begin, last + 1 - begin)
    torch.testing.assert_close(
        tile[:, :, inside, inside], whole[:, :, first : last + 1, first : last + 1]
    )
