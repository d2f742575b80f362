"""HBAO against closed forms, and what every picture of it has to be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from deepshade_report.baselines.ao import hbao
from deepshade_report.baselines.ao.hbao import HBAO, Parameters, occlude
from deepshade_report.baselines.ao.horizons import open_field

from .walls import cast, degenerate, groove, rubble

# nothing but the method: no fade before the radius, no bias, no blur
PLAIN = Parameters(falloff=0.02, bias=0.0, blur=0)


def beside_the_crease(left: float, right: float) -> list[float]:
    """Mean of a few pixels to either side of a groove's crease, from many samples each."""
    view = groove(left, right)
    sides = slice(122, 126), slice(130, 134)
    mask = np.zeros_like(view.background)
    for columns in sides:
        mask[126:130, columns] = True
    image = occlude(open_field(view).within(mask), 32, 64, PLAIN)
    return [float(image[126:130, columns].mean()) for columns in sides]


@pytest.mark.parametrize("slope", [15.0, 30.0, 45.0, 60.0])
def test_a_groove_is_occluded_as_much_as_its_walls_rise(slope: float) -> None:
    # From a wall of slope β, the horizon rises to atan(k cos θ) and the tangent falls as far,
    # k = tan β, over half of all directions θ; the other half lies on the wall itself. So
    # 1 / 2π ∫ 2 k cos θ / √(1 + k² cos² θ) dθ = 2 β / π: unlike the sky's, no cosine weighs it.
    expected = 1 - 2 * math.radians(slope) / math.pi
    assert beside_the_crease(slope, slope) == pytest.approx([expected] * 2, abs=0.03)


def test_a_step_is_attenuated_by_its_distance() -> None:
    # between a floor and a wall too steep to see, only the wall's edge occludes: nearer, more
    view = cast([((0, 0, 1), -1.0)], size=64, fov=50.0, radius=0.4)
    position = view.position.copy()
    position[:, :, 40:] *= 0.8
    view = replace(view, position=position)
    method = HBAO(16, 16, replace(PLAIN, falloff=1.0))
    method.prepare(view)
    rows = method.shade(view)[24:40]
    profile = rows.reshape(16, 16, 4).mean((0, 2))[4:10]
    assert (np.diff(profile) < 0).all()


def test_a_bias_hides_shallow_creases() -> None:
    view = groove(8, 8, size=64)
    for bias, least in ((0.0, 0.0), (0.6, 0.999)):
        method = HBAO(8, 8, replace(PLAIN, bias=bias))
        method.prepare(view)
        middle = method.shade(view)[24:40, 24:40]
        assert middle.min() >= least
        assert (middle.mean() < 0.95) == (bias == 0)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_a_plane_is_open(tilt: float) -> None:
    slope = math.tan(math.radians(tilt))
    view = cast([((slope, 0.3 * slope, 1.0), -1.0)], size=64, fov=30.0, radius=0.2)
    method = HBAO(8, 6, Parameters())
    method.prepare(view)
    inside = method.shade(view)[16:-16, 16:-16]
    assert inside == pytest.approx(1, abs=1e-3 if tilt == 0 else 0.03)  # samples snap to pixels


def test_what_is_out_of_reach_occludes_nothing() -> None:
    view = cast([((0, 0, 1), -2.0)], size=64, fov=50.0, radius=0.3)
    near = view.position.copy()
    near[:, 20:40, 20:40] /= 2  # a plate halfway to the eye
    method = HBAO(4, 6, Parameters(blur=0))
    view = replace(view, position=near)
    method.prepare(view)
    assert method.shade(view) == pytest.approx(1, abs=0.025)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_scene_s_scale_changes_nothing(scale: float) -> None:
    method = HBAO(2, 4)
    images = []
    for view in (rubble(), rubble(scale=scale)):
        method.prepare(view)
        images.append(method.shade(view))
    difference = np.abs(images[0] - images[1])
    assert images[0].std() > 0.05
    assert np.mean(difference > 1e-3) < 0.002  # a sample may round to its neighbour


def test_background_stays_open() -> None:
    view = rubble()
    method = HBAO(2, 4)
    method.prepare(view)
    assert (method.shade(view)[view.background] == 1).all()


@pytest.mark.parametrize("name", degenerate())
def test_no_input_yields_nonsense(name: str) -> None:
    view = degenerate()[name]
    for parameters in (hbao.default(), Parameters(bias=0.5, spread=2.0)):
        method = HBAO(2, 3, parameters)
        method.prepare(view)
        image = method.shade(view)
        assert image.shape == view.background.shape
        assert image.dtype == np.float32
        assert ((image >= 0) & (image <= 1)).all()


def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer() -> None:
    every, quick = hbao.methods(False), hbao.methods(True)
    samples = [m.settings["directions"] * m.settings["steps"] for m in every]
    assert samples == sorted(set(samples))
    assert len(quick) < len(every)
    assert all(m.name == "HBAO" for m in [*every, *quick])
