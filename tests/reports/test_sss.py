"""Subsurface scattering in screen space against the profile's integrals."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import k0

from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .walls import cast, degenerate, rubble

try:
    from deepshade_report.baselines.sss import burley, separable
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

SIZE, FOV = 64, 30.0
PIXEL = 2 * math.tan(math.radians(FOV / 2)) / SIZE  # of a plane 1 away
WIDE = separable.Parameters(reach=24.0, spread=2.5)
BEST = [burley.burley(200, burley.Parameters()), separable.separable(81, WIDE)]
BOTH = [burley.burley(16), separable.separable(7)]


def scattering(view: View, light: Any, free: Any) -> View:
    """The view as one of this effect, with this light and mean free path."""
    shape = (3, *view.background.shape)
    planes = [np.broadcast_to(np.asarray(x, np.float32), shape).copy() for x in (light, free)]
    planes[1][:, view.background] = 0
    attributes = {**view.attributes, "light": planes[0], "scatter": planes[1]}
    return replace(view, effect=EFFECTS["sss"], attributes=attributes, reference=planes[0])


def frontal(size: int = SIZE) -> View:
    return cast([((0, 0, 1), -1.0)], size=size, fov=FOV, radius=1.0)


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


def test_radii_hold_their_share_of_the_profile() -> None:
    share = np.linspace(0.01, 0.99, 50)
    r = burley.radius(share)
    assert 1 - np.exp(-r) / 4 - 3 * np.exp(-r / 3) / 4 == pytest.approx(share, abs=1e-9)


def test_the_kernel_is_the_line_spread() -> None:
    for x in (0.2, 1.0, 5.0):
        t = (np.arange(20000) + 0.5) / 20000 * x
        expected = float(np.mean(k0(t) + k0(t / 3))) * x / (4 * math.pi)
        assert separable.line_share(x) == pytest.approx(expected, abs=2e-3)
    _, weights = separable.kernel(8, 10.0, 2.0)
    assert weights[0] + 2 * weights[1:].sum() == pytest.approx(1)
    assert (weights > 0).all()


@pytest.mark.parametrize("method", BOTH, ids=lambda m: m.name)
def test_constant_light_stays(method: Any) -> None:
    light = np.array([1.0, 1e5, 1e-3]).reshape(3, 1, 1)
    free = np.array([0.5, 3.0, 20.0]).reshape(3, 1, 1) * PIXEL
    for view in (frontal(), rubble()):
        found = shaded(method, scattering(view, light, free))
        assert found == pytest.approx(np.broadcast_to(light, found.shape), rel=1e-4)


@pytest.mark.parametrize("method", BEST, ids=lambda m: m.name)
def test_an_edge_of_light_spreads_as_a_line_of_light_does(method: Any) -> None:
    light = np.zeros((3, SIZE, SIZE), np.float32)
    light[:, :, SIZE // 2 :] = 1
    pixels = np.array([1.0, 1.5, 2.0])
    image = shaded(method, scattering(frontal(), light, pixels.reshape(3, 1, 1) * PIXEL))
    for plane, free in zip(image, pixels, strict=True):
        profile = plane[24:40].mean(0)
        x = (np.arange(SIZE) + 0.5 - SIZE / 2) / free
        t = np.linspace(0, 40, 400001)[1:]
        spread = np.cumsum(k0(t) + k0(t / 3)) * t[0] / (4 * math.pi)
        expected = 0.5 + np.sign(x) * np.interp(np.abs(x), t, spread)
        inner = slice(16, 48)
        assert profile[inner] == pytest.approx(expected[inner], abs=0.02)


@pytest.mark.parametrize("method", BEST, ids=lambda m: m.name)
def test_nothing_bleeds_across_a_step_in_depth(method: Any) -> None:
    view = frontal()
    view.attributes["position"][:, :, SIZE // 2 :] *= 4  # the right half, far behind
    light = np.where(np.arange(SIZE) < SIZE // 2, 0.0, 1.0)
    image = shaded(method, scattering(view, light, 2 * PIXEL))
    assert image[:, :, : SIZE // 2].max() < 1e-3
    assert image[:, :, SIZE // 2 :].min() > 0.999


@pytest.mark.parametrize("method", BOTH, ids=lambda m: m.name)
def test_what_does_not_scatter_keeps_its_light_and_lends_none(method: Any) -> None:
    light = np.where(np.arange(SIZE) < SIZE // 2, 1.0, 50.0)
    free = np.zeros((3, SIZE, SIZE), np.float32)
    free[:2, :, : SIZE // 2] = 4 * PIXEL
    image = shaded(method, scattering(frontal(), light, free))
    assert image == pytest.approx(np.broadcast_to(light, image.shape), rel=1e-4)


@pytest.mark.parametrize("method", BOTH, ids=lambda m: m.name)
def test_light_passes_linearly_and_scale_changes_nothing(method: Any) -> None:
    rng = np.random.default_rng(3)
    a, b = rng.random((2, 3, SIZE, SIZE)).astype(np.float32)
    views = [scattering(rubble(), x, 0.02) for x in (a, b, 3 * a + 1e3 * b)]
    first, second, both = (shaded(method, view) for view in views)
    assert both == pytest.approx(3 * first + 1e3 * second, rel=1e-4)
    large = shaded(method, scattering(rubble(scale=1e4), a, 200.0))
    assert np.mean(np.abs(large - first) > 1e-3) < 0.01  # a tap may round to its neighbour


@pytest.mark.parametrize("name", degenerate())
@pytest.mark.parametrize("method", BOTH, ids=lambda m: m.name)
def test_no_input_yields_nonsense(method: Any, name: str) -> None:
    view = degenerate()[name]
    image = shaded(method, scattering(view, 2.0, 0.1))
    assert image == pytest.approx(np.full((3, *view.background.shape), 2.0), rel=1e-4)


@pytest.mark.parametrize("module", [burley, separable])
def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer(module: Any) -> None:
    taps = [method.settings["taps"] for method in module.methods(False)]
    assert taps == sorted(set(taps))
    assert len(module.methods(True)) < len(taps)
