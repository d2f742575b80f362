"""GTAO against closed forms, and what every picture of it has to be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from deepshade_report.baselines.ao import gtao
from deepshade_report.baselines.ao.gtao import GTAO, Parameters, occlude
from deepshade_report.baselines.ao.horizons import open_field

from .walls import cast, degenerate, groove, rubble

# nothing but the method: no fade before the radius, no blur
PLAIN = Parameters(radius=1.0, falloff=0.02, spread=1.0, blur=0)


def beside_the_crease(left: float, right: float) -> list[float]:
    """Mean of a few pixels to either side of a groove's crease, from many samples each."""
    view = groove(left, right)
    sides = slice(122, 126), slice(130, 134)
    mask = np.zeros_like(view.background)
    for columns in sides:
        mask[126:130, columns] = True
    image = occlude(open_field(view).within(mask), 16, 64, PLAIN)
    return [float(image[126:130, columns].mean()) for columns in sides]


@pytest.mark.parametrize("slope", [15.0, 30.0, 45.0, 60.0])
def test_a_groove_shows_as_much_of_the_sky_as_its_angle_leaves(slope: float) -> None:
    # the form factor to the sky from a wall of a wedge that opens by φ: (1 - cos φ) / 2
    expected = (1 - math.cos(math.radians(180 - 2 * slope))) / 2
    assert beside_the_crease(slope, slope) == pytest.approx([expected] * 2, abs=0.03)


@pytest.mark.parametrize("tilt", [30.0, 45.0, 60.0])
def test_half_of_the_sky_is_left_where_a_floor_meets_a_wall(tilt: float) -> None:
    assert beside_the_crease(tilt, 90 - tilt) == pytest.approx([0.5] * 2, abs=0.035)


@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_a_plane_is_open(tilt: float) -> None:
    slope = math.tan(math.radians(tilt))
    view = cast([((slope, 0.3 * slope, 1.0), -1.0)], size=64, fov=30.0, radius=0.2)
    method = GTAO(8, 6, Parameters())
    method.prepare(view)
    inside = method.shade(view)[16:-16, 16:-16]
    assert inside == pytest.approx(1, abs=1e-3 if tilt == 0 else 0.03)  # samples snap to pixels


def test_what_is_out_of_reach_occludes_nothing() -> None:
    view = cast([((0, 0, 1), -2.0)], size=64, fov=50.0, radius=0.3)
    near = view.position.copy()
    near[:, 20:40, 20:40] /= 2  # a plate halfway to the eye
    method = GTAO(4, 6, Parameters(blur=0))
    view = replace(view, position=near)
    method.prepare(view)
    assert method.shade(view) == pytest.approx(1, abs=0.025)


def test_thickness_and_compensation_only_let_more_light_in() -> None:
    field = open_field(rubble())
    plain = occlude(field, 3, 6, Parameters())
    for name in ("thickness", "thin"):
        thinner = occlude(field, 3, 6, replace(Parameters(), **{name: 0.5}))
        assert (thinner >= plain - 1e-5).all()
        assert thinner.mean() > plain.mean() + 1e-3


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_scene_s_scale_changes_nothing(scale: float) -> None:
    method = GTAO(2, 4)
    images = []
    for view in (rubble(), rubble(scale=scale)):
        method.prepare(view)
        images.append(method.shade(view))
    difference = np.abs(images[0] - images[1])
    assert images[0].std() > 0.05
    assert np.mean(difference > 1e-3) < 0.002  # a sample may round to its neighbour


def test_background_stays_open() -> None:
    view = rubble()
    method = GTAO(2, 4)
    method.prepare(view)
    assert (method.shade(view)[view.background] == 1).all()


@pytest.mark.parametrize("name", degenerate())
def test_no_input_yields_nonsense(name: str) -> None:
    view = degenerate()[name]
    for parameters in (gtao.default(), replace(Parameters(), thickness=0.3, thin=0.5, bias=0.1)):
        method = GTAO(2, 3, parameters)
        method.prepare(view)
        image = method.shade(view)
        assert image.shape == view.background.shape
        assert image.dtype == np.float32
        assert ((image >= 0) & (image <= 1)).all()


def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer() -> None:
    every, quick = gtao.methods(False), gtao.methods(True)
    samples = [m.settings["slices"] * m.settings["steps"] for m in every]
    assert samples == sorted(set(samples))
    assert len(quick) < len(every)
    assert all(m.name == "GTAO" for m in [*every, *quick])
