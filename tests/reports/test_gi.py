"""Indirect light in screen space against form factors and what light must obey."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepshade.effects import EFFECTS
from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .walls import degenerate, groove, rubble

try:
    from deepshade_report.baselines.gi import bitmask as module
    from deepshade_report.baselines.gi.bitmask import Parameters, bitmask
    from deepshade_report.baselines.gi.onelayer import Parameters as Thick
    from deepshade_report.baselines.gi.onelayer import onelayer
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

# nothing but the method: fine samples of single pixels, thick, no blur
PLAIN = Parameters(thickness=0.5, lod=-9.0, backface=1.0, blur=0)


def lit(view: View, light: Any = 1.0) -> View:
    """The view as one of this effect, with this light."""
    planes = np.broadcast_to(np.asarray(light, np.float32), (3, *view.background.shape))
    planes = np.where(view.background, 0, planes).astype(np.float32)
    attributes = {**view.attributes, "light_diffuse": planes}
    return replace(view, effect=EFFECTS["gi"], attributes=attributes, reference=planes)


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


@pytest.mark.parametrize("slope", [30.0, 60.0])
def test_a_wall_of_a_groove_sees_the_other_by_its_form_factor(slope: float) -> None:
    # beside the crease the other wall fills all but (1 - cos φ) / 2 of the sky, φ the groove's
    # opening: (1 + cos φ) / 2 of its light arrives
    expected = (1 + math.cos(math.radians(180 - 2 * slope))) / 2
    image = shaded(bitmask(16, 64, PLAIN), lit(groove(slope, slope)))[:, 126:130]
    found = [float(image[..., c].mean()) for c in (slice(122, 126), slice(130, 134))]
    assert found == pytest.approx([expected] * 2, abs=0.03)


def test_two_perpendicular_strips_exchange_their_form_factor() -> None:
    # a floor and a wall at right angles, both tilted 45°: a point x from the crease sees the wall
    # as far as the radius R reaches: ∫ over hits within R of cosθ / π, here by quadrature
    view = groove(45, 45)
    view = replace(view, radius=view.radius * 0.4)  # all within it is in the picture
    image = shaded(bitmask(24, 64, PLAIN), lit(view))
    for pixels in (16, 40):
        x = 2 / 256 * math.tan(math.radians(4)) * pixels / math.cos(math.radians(45)) / view.radius
        n = 400
        u, v = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2)).reshape(2, -1)
        sine, phi = np.sqrt(u), 2 * math.pi * v
        towards = sine * np.cos(phi)  # a cosine-weighted direction's part towards the wall
        hits = towards > x  # it meets the wall, x away, within R = 1
        found = float(image[0, 120:136, 128 + pixels - 2 : 128 + pixels + 2].mean())
        assert found == pytest.approx(hits.mean(), rel=0.05, abs=0.01)


def test_light_passes_linearly_and_none_comes_from_nothing() -> None:
    view, rng = rubble(), np.random.default_rng(5)
    a, b = rng.random((2, 3, 64, 64)).astype(np.float32)
    method = bitmask(2, 6, replace(PLAIN, blur=2, lod=-1.0))
    first, second, both = (shaded(method, lit(view, x)) for x in (a, b, 3 * a + 1e3 * b))
    assert first.mean() > 0.05
    assert both == pytest.approx(3 * first + 1e3 * second, rel=1e-4, abs=1e-3)
    assert not shaded(method, lit(view, 0.0)).any()
    assert not first[:, view.background].any()


def test_colours_do_not_mix() -> None:
    image = shaded(bitmask(2, 6), lit(rubble(), np.array([1.0, 0, 0]).reshape(3, 1, 1)))
    assert image[0].any()
    assert not image[1:].any()


def test_nothing_beyond_the_radius_counts() -> None:
    view = groove(45, 45, size=64)
    near = replace(view, radius=view.radius * 0.1)
    image = shaded(bitmask(4, 16, PLAIN), lit(near))
    assert image[:, :, :24].max() < 0.04  # a sector, where samples snap to pixels
    assert image[:, 24:40, 30:34].min() > 0.2


def test_the_scene_s_scale_changes_nothing() -> None:
    one, other = (shaded(bitmask(2, 4), lit(view)) for view in (rubble(), rubble(scale=1e4)))
    assert one.std() > 0.005
    assert np.mean(np.abs(one - other) > 1e-3) < 0.01  # a sample may round to its neighbour


@pytest.mark.parametrize("name", degenerate())
def test_no_input_yields_nonsense(name: str) -> None:
    view = degenerate()[name]
    image = shaded(bitmask(2, 3), lit(view))
    assert image.shape == (3, *view.background.shape)
    assert image.dtype == np.float32
    assert (np.isfinite(image) & (image >= 0)).all()


def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer() -> None:
    samples = [math.prod(method.settings.values()) for method in module.methods(False)]
    assert samples == sorted(set(samples))
    assert len(module.methods(True)) < len(samples)


def test_marched_rays_meet_the_other_strip_within_the_radius() -> None:
    # as for two perpendicular strips above: what x away meets the wall, within R = 1
    view = groove(45, 45, size=128)
    view = replace(view, radius=view.radius * 0.4)
    image = shaded(onelayer(128, Thick(0.5)), lit(view))
    u, v = np.random.default_rng(1).random((2, 100_000))
    towards = np.sqrt(u) * np.cos(2 * math.pi * v)  # a direction's part towards the wall
    for pixels in (8, 20):
        x = 2 / 128 * math.tan(math.radians(4)) * pixels / math.cos(math.radians(45)) / view.radius
        found = float(image[0, 60:68, 64 + pixels - 2 : 64 + pixels + 2].mean())
        assert found == pytest.approx((towards > x).mean(), rel=0.06, abs=0.01)


def test_marched_rays_carry_light_linearly_and_a_plane_not_at_all() -> None:
    view, rng = rubble(), np.random.default_rng(5)
    a, b = rng.random((2, 3, 64, 64)).astype(np.float32)
    first, second, both = (shaded(onelayer(8), lit(view, x)) for x in (a, b, 3 * a + 1e3 * b))
    assert first.mean() > 0.005
    assert both == pytest.approx(3 * first + 1e3 * second, rel=1e-4, abs=1e-3)
    assert not first[:, view.background].any()
    assert shaded(onelayer(8), lit(groove(0, 0, size=64))).max() < 1e-3


@pytest.mark.parametrize("name", degenerate())
def test_no_input_makes_marched_rays_nonsense(name: str) -> None:
    view = degenerate()[name]
    image = shaded(onelayer(4), lit(view))
    assert image.shape == (3, *view.background.shape)
    assert (np.isfinite(image) & (image >= 0)).all()
