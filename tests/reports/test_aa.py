"""Edge filters against the exact coverage of slanted edges, and what they have to leave alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .plates import noise, plates

try:
    import drjit as dr

    from deepshade_report.baselines.aa import areas, cmaa2, fxaa, smaa
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

SMAA = [setting for setting in smaa.SETTINGS if setting[2] >= 16]
ALL = [
    *(smaa.smaa(*setting, smaa.PUBLISHED) for setting in smaa.SETTINGS),
    *(cmaa2.cmaa2(*setting, cmaa2.PUBLISHED) for setting in cmaa2.SETTINGS),
    *(fxaa.fxaa(preset, fxaa.PUBLISHED) for preset in fxaa.SETTINGS),
]


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


def slanted(degrees: float, size: int = 64, bright: float = 1.0) -> tuple[View, Float]:
    """A bright half plane whose edge rises by an angle, sampled at centres, and its coverage."""
    normal = -math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    fine = (np.arange(size * 16) + 0.5) / 16 - size / 2 - 0.21

    def inside(at: np.ndarray) -> np.ndarray:
        return np.asarray(normal[0] * at[None, :] + normal[1] * at[:, None] > 0)

    sampled = inside(np.arange(size) + 0.5 - size / 2 - 0.21)
    coverage = inside(fine).reshape(size, 16, size, 16).mean((1, 3))
    depth = np.where(sampled, 1.0, 3.0)
    view = plates("aa", light=0.02 + bright * sampled, depth=depth)
    return view, np.asarray(0.02 + bright * coverage, np.float32)


def improvement(method: Any, degrees: float) -> float:
    """How many times less the error is than the input's, away from the border."""
    view, exact = slanted(degrees)
    image = shaded(method, view)[0]
    inner = np.s_[12:-12, 12:-12]
    before = np.abs(view.attributes["light"][0] - exact)[inner].mean()
    return float(before / np.abs(image - exact)[inner].mean())


@pytest.mark.parametrize("degrees", [8.0, 172.0, 82.0, 98.0, 45.0, 40.0, 130.0])
@pytest.mark.parametrize("setting", SMAA)
def test_smaa_comes_near_an_edge_s_coverage(setting: Any, degrees: float) -> None:
    limit = 1.5 if 30 < degrees % 90 < 60 else 2.0
    if setting[3] == 0 and 30 < degrees % 90 < 60:
        limit = 1.0  # no search along diagonals
    assert improvement(smaa.smaa(*setting, smaa.PUBLISHED), degrees) >= limit


@pytest.mark.parametrize("degrees", [8.0, 172.0, 82.0, 98.0])
@pytest.mark.parametrize("setting", cmaa2.SETTINGS)
def test_cmaa2_comes_near_an_edge_s_coverage(setting: Any, degrees: float) -> None:
    assert improvement(cmaa2.cmaa2(*setting, cmaa2.PUBLISHED), degrees) > 2


@pytest.mark.parametrize("degrees", [8.0, 20.0])
def test_cmaa2_turns_with_the_picture(degrees: float) -> None:
    method = cmaa2.cmaa2(*cmaa2.SETTINGS[3], cmaa2.PUBLISHED)
    light = slanted(degrees)[0].attributes["light"]
    flat = np.ones(light.shape[1:])
    upright = shaded(method, plates("aa", light=light, depth=flat))
    assert (upright != light).any()
    for turns in (1, 2, 3):
        turned = np.rot90(light, turns, (1, 2))
        image = shaded(method, plates("aa", light=turned, depth=flat))
        assert np.rot90(image, -turns, (1, 2)) == pytest.approx(upright, abs=1e-6)


@pytest.mark.parametrize("degrees", [8.0, 82.0, 98.0])
@pytest.mark.parametrize("preset", fxaa.SETTINGS)
def test_fxaa_comes_nearer_to_an_edge_s_coverage(preset: int, degrees: float) -> None:
    assert improvement(fxaa.fxaa(preset, fxaa.PUBLISHED), degrees) > 1.4


@pytest.mark.parametrize("method", ALL, ids=lambda m: f"{m.name} {list(m.settings.values())}")
def test_flat_areas_and_one_pixel_stay_as_they_are(method: Any) -> None:
    light = np.full((16, 24), 3e4)
    light[:, 12:] += 10  # an edge that isn't seen
    view = plates("aa", light=light, depth=np.ones((16, 24)))
    assert (shaded(method, view) == view.attributes["light"]).all()
    one = plates("aa", light=np.ones((1, 1)), depth=np.ones((1, 1)))
    assert shaded(method, one) == pytest.approx(1)


@pytest.mark.parametrize("method", ALL, ids=lambda m: f"{m.name} {list(m.settings.values())}")
def test_exposure_changes_nothing(method: Any) -> None:
    light = noise()
    one, two = (
        shaded(method, plates("aa", light=light * f, depth=np.ones((32, 48)))) for f in (1, 1024)
    )
    assert two == pytest.approx(1024 * one, rel=1e-4)
    assert one.min() >= light.min() * 0.999
    assert one.max() <= light.max() * 1.001


@pytest.mark.parametrize("make", [smaa.TUNABLE, cmaa2.TUNABLE, fxaa.TUNABLE])
def test_what_was_recorded_for_one_view_shades_another(make: Any) -> None:
    method, depth = make.make(make.published), np.ones((32, 48))
    shaded(method, plates("aa", light=noise(seed=1), depth=depth))
    replayed = shaded(method, plates("aa", light=noise(seed=2), depth=depth))
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        traced = shaded(method, plates("aa", light=noise(seed=2), depth=depth))
    assert replayed == pytest.approx(traced, rel=1e-5)


def test_areas_along_diagonals_are_what_counting_finds() -> None:
    table = areas.diagonal_areas().numpy().reshape(4, 4, areas.DIAGONAL, areas.DIAGONAL, 2)
    left, right = 2, 3
    place = (np.arange(400) + 0.5) / 400
    x, y = 1 + left + place[None, :], left + place[:, None]
    # from (1, 1) to (1, 0) and six pixels on: level edges at both ends
    under = (y - 1) * 6 < (x - 1) * 5
    expected = 1 - under.mean(), ((y + 1 - 1) * 6 < (x - 1) * 5).mean()
    assert table[2, 2, left, right] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("module", [smaa, cmaa2, fxaa])
def test_quick_is_fewer(module: Any) -> None:
    assert len(module.methods(True)) < len(module.methods(False))
