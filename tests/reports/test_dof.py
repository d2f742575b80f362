"""The ring gather and marched rays against what a lens does to points, edges and even light."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .plates import noise, plates

try:
    from deepshade_report.baselines.dof import rings
    from deepshade_report.baselines.dof.onelayer import onelayer
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

KINDS = [(8, False), (4, True)]


def shaded(count: int, half: bool, view: View) -> Float:
    method = rings.rings(count, half, rings.PUBLISHED)
    method.prepare(view)
    return np.asarray(method.shade(view))


@pytest.mark.parametrize(("count", "half"), KINDS)
def test_what_is_in_focus_stays_as_it_is(count: int, half: bool) -> None:
    light = noise(31, 47)
    view = plates("dof", focal=np.zeros((31, 47)), light=light)
    assert (shaded(count, half, view) == light).all()


@pytest.mark.parametrize(("count", "half"), KINDS)
def test_even_light_stays_even(count: int, half: bool) -> None:
    focal = np.random.default_rng(2).normal(0, 20, (33, 48))
    view = plates("dof", focal=focal, light=np.full((33, 48), 3e4))
    assert shaded(count, half, view) == pytest.approx(3e4, rel=1e-5)


@pytest.mark.parametrize("side", [1, -1])
def test_a_point_spreads_over_its_circle_and_keeps_its_energy(side: int) -> None:
    light = np.zeros((96, 96))
    light[48, 48] = 1000.0
    image = shaded(8, False, plates("dof", focal=np.full((96, 96), side * 24.0), light=light))[0]
    assert image.sum() == pytest.approx(1000, rel=0.05)
    row, column = np.mgrid[:96, :96]
    distance = np.hypot(row - 48, column - 48)
    assert image[distance > 12 + 3].max() == 0  # a sample may lie a texel beyond
    inner = image[distance < 10].mean()
    assert inner == pytest.approx(1000 / (np.pi * 12**2), rel=0.2)


@pytest.mark.parametrize(("count", "half"), KINDS)
def test_a_sharp_edge_does_not_bleed_into_what_is_behind_it(count: int, half: bool) -> None:
    sharp = np.zeros((64, 64), bool)
    sharp[:, :32] = True
    light, focal = np.where(sharp, 100.0, 1.0), np.where(sharp, 0.0, 20.0)
    image = shaded(count, half, plates("dof", focal=focal, light=light))[0]
    assert image[:, :32] == pytest.approx(100.0, rel=0.03 if half else 1e-6)
    assert image[:, 32:] == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize(("count", "half"), KINDS)
def test_a_near_edge_covers_half_of_its_circle(count: int, half: bool) -> None:
    near = np.zeros((64, 128), bool)
    near[:, :64] = True
    light, focal = np.where(near, 1.0, 0.0), np.where(near, -24.0, 0.0)
    image = shaded(count, half, plates("dof", focal=focal, light=light))[0][16:-16].mean(0)
    # the share of a circle beyond a line at a distance d from its middle
    d = np.clip((np.arange(128) - 63.5) / 12, -1, 1)
    exact = (np.arccos(d) - d * np.sqrt(1 - d * d)) / np.pi
    assert np.abs(image - exact).mean() < 0.25 * np.abs((np.arange(128) < 64) - exact).mean()


@pytest.mark.parametrize(("count", "half"), KINDS)
def test_light_passes_linearly(count: int, half: bool) -> None:
    focal = np.random.default_rng(2).normal(0, 10, (32, 48))
    one, two = (
        shaded(count, half, plates("dof", focal=focal, light=noise() * f)) for f in (1, 1e5)
    )
    assert two == pytest.approx(1e5 * one, rel=1e-4)


@pytest.mark.parametrize(("count", "half"), KINDS)
@pytest.mark.parametrize("focal", [-9.0, 9.0, np.inf])
def test_one_pixel(count: int, half: bool, focal: float) -> None:
    view = plates("dof", focal=np.full((1, 1), focal), light=np.full((1, 1), 2.0))
    assert shaded(count, half, view) == pytest.approx(2)


def test_settings_go_from_cheap_to_best() -> None:
    every, quick = rings.methods(False), rings.methods(True)
    taps = [(2 * m.settings["rings"] - 1) ** 2 / (4 if m.settings["half"] else 1) for m in every]
    assert taps == sorted(taps)
    assert len(quick) < len(every)


def marched(rays: int, view: View) -> Float:
    method = onelayer(rays)
    method.prepare(view)
    return np.asarray(method.shade(view))


@pytest.mark.parametrize("side", [1, -1])
def test_marched_rays_spread_a_point_evenly_over_its_circle(side: int) -> None:
    light = np.zeros((64, 64))
    light[32, 32] = 1000.0
    view = plates("dof", focal=np.full((64, 64), side * 24.0), light=light)
    image = marched(4096, view)[0]
    row, column = np.mgrid[:64, :64]
    distance = np.hypot(row - 32, column - 32)
    assert image[distance > 12 + 1].max() == 0
    assert image[distance < 11].mean() == pytest.approx(1000 / (np.pi * 12**2), rel=0.05)


@pytest.mark.parametrize(("near", "far"), [(-24.0, 0.0), (-24.0, 16.0), (0.0, 24.0)])
def test_marched_rays_meet_what_is_nearest(near: float, far: float) -> None:
    left = np.zeros((64, 128), bool)
    left[:, :64] = True
    view = plates("dof", focal=np.where(left, near, far), light=np.where(left, 1.0, 0.0))
    image = marched(512, view)[0][16:-16].mean(0)
    # the share of the near half's circle beyond a line; what that hides is continued
    away = np.arange(128) - 63.5
    d = np.clip(away / max(-near / 2, 1e-3), -1, 1)
    exact = (np.arccos(d) - d * np.sqrt(1 - d * d)) / np.pi
    assert image == pytest.approx(exact, abs=0.03)


def test_marched_rays_keep_what_is_in_focus_and_carry_light_linearly() -> None:
    light = noise(32, 48)
    still = plates("dof", focal=np.zeros((32, 48)), light=light)
    assert marched(64, still) == pytest.approx(light, rel=1e-5)
    focal = np.random.default_rng(2).normal(0, 10, (32, 48))
    one, two = (marched(64, plates("dof", focal=focal, light=light * f)) for f in (1, 1e5))
    assert two == pytest.approx(1e5 * one, rel=1e-4)


@pytest.mark.parametrize("focal", [-9.0, 9.0, 1e6, np.inf])
def test_marched_rays_of_one_pixel(focal: float) -> None:
    view = plates("dof", focal=np.full((1, 1), focal), light=np.full((1, 1), 2.0))
    assert marched(64, view) == pytest.approx(2)
