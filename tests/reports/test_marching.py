"""HBAO and GTAO against closed forms and scalar loops, and what every picture of them has to be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from deepshade.errors import DeepshadeError
from deepshade_report.view import Float, View

from .walls import cast, degenerate, groove, rubble

try:
    from deepshade_report.baselines import screen
    from deepshade_report.baselines.ao import gtao, hbao, marching
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

# nothing but the method: no fade before the radius, no bias, no blur
PLAIN = marching.Parameters(radius=1.0, falloff=0.02, bias=0.0, spread=1.0, blur=0)
BOTH = [(hbao.hbao, hbao.PUBLISHED), (gtao.gtao, gtao.PUBLISHED)]
UNEVEN = marching.Parameters(1.3, 0.4, 0.05, 1.6, intensity=1.2, power=0.8, blur=0)


def shaded(method: Any, view: View) -> Float:
    method.prepare(view)
    return np.asarray(method.shade(view))


def beside_the_crease(method: Any, left: float, right: float) -> list[float]:
    """Mean of a few pixels to either side of a groove's crease, from many samples each."""
    image = shaded(method, groove(left, right))
    return [float(image[126:130, columns].mean()) for columns in (slice(122, 126), slice(130, 134))]


@pytest.mark.parametrize("slope", [15.0, 60.0])
def test_hbao_of_a_groove_is_as_much_as_its_walls_rise(slope: float) -> None:
    # From a wall of slope β, the horizon rises to atan(k cos θ) and the tangent falls as far,
    # k = tan β, over half of all directions θ; the other half lies on the wall itself. So
    # 1 / 2π ∫ 2 k cos θ / √(1 + k² cos² θ) dθ = 2 β / π: unlike the sky's, no cosine weighs it.
    expected = 1 - 2 * math.radians(slope) / math.pi
    found = beside_the_crease(hbao.hbao(32, 64, PLAIN), slope, slope)
    assert found == pytest.approx([expected] * 2, abs=0.03)


@pytest.mark.parametrize("slope", [15.0, 60.0])
def test_gtao_of_a_groove_is_the_sky_that_its_angle_leaves(slope: float) -> None:
    # the form factor to the sky from a wall of a wedge that opens by φ: (1 - cos φ) / 2
    expected = (1 - math.cos(math.radians(180 - 2 * slope))) / 2
    found = beside_the_crease(gtao.gtao(16, 64, PLAIN), slope, slope)
    assert found == pytest.approx([expected] * 2, abs=0.03)


@pytest.mark.parametrize("tilt", [30.0, 45.0])
def test_gtao_leaves_half_of_the_sky_where_a_floor_meets_a_wall(tilt: float) -> None:
    found = beside_the_crease(gtao.gtao(16, 64, PLAIN), tilt, 90 - tilt)
    assert found == pytest.approx([0.5] * 2, abs=0.035)


@pytest.mark.parametrize(("kind", "published"), BOTH)
@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_a_plane_is_open(kind: Any, published: Any, tilt: float) -> None:
    slope = math.tan(math.radians(tilt))
    view = cast([((slope, 0.3 * slope, 1.0), -1.0)], size=64, fov=30.0, radius=0.2)
    inside = shaded(kind(8, 6, published), view)[16:-16, 16:-16]
    assert inside == pytest.approx(1, abs=1e-3 if tilt == 0 else 0.03)  # samples snap to pixels


@pytest.mark.parametrize(("kind", "published"), BOTH)
def test_what_is_out_of_reach_occludes_nothing(kind: Any, published: Any) -> None:
    view = cast([((0, 0, 1), -2.0)], size=64, fov=50.0, radius=0.3)
    view.attributes["position"][:, 20:40, 20:40] /= 2  # a plate halfway to the eye
    assert shaded(kind(4, 6, replace(published, blur=0)), view) == pytest.approx(1, abs=0.025)


def test_a_bias_hides_shallow_creases() -> None:
    for bias, least in ((0.0, 0.0), (0.6, 0.999)):
        image = shaded(hbao.hbao(8, 8, replace(PLAIN, bias=bias)), groove(8, 8, size=64))
        assert image[24:40, 24:40].min() >= least
        assert (image[24:40, 24:40].mean() < 0.95) == (bias == 0)


@pytest.mark.parametrize(("kind", "published"), BOTH)
@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_the_scene_s_scale_changes_nothing(kind: Any, published: Any, scale: float) -> None:
    one, other = (shaded(kind(2, 4), view) for view in (rubble(), rubble(scale=scale)))
    assert one.std() > 0.05
    assert np.mean(np.abs(one - other) > 1e-3) < 0.002  # a sample may round to its neighbour
    assert (one[rubble().background] == 1).all()


@pytest.mark.parametrize("name", degenerate())
@pytest.mark.parametrize(("kind", "published"), BOTH)
def test_no_input_yields_nonsense(kind: Any, published: Any, name: str) -> None:
    view = degenerate()[name]
    for parameters in (None, replace(published, bias=0.5, spread=2.0)):
        image = shaded(kind(2, 3, parameters), view)
        assert image.shape == view.background.shape
        assert image.dtype == np.float32
        assert ((image >= 0) & (image <= 1)).all()


@pytest.mark.parametrize("module", [hbao, gtao])
def test_the_settings_go_from_cheap_to_best_and_quick_is_fewer(module: Any) -> None:
    every, quick = module.methods(False), module.methods(True)
    samples = [math.prod(method.settings.values()) for method in every]
    assert samples == sorted(set(samples))
    assert len(quick) < len(every)


def test_hbao_is_the_sum_of_its_rises() -> None:
    p = UNEVEN

    def pair(sides: list[list[tuple[float, float]]], tilt: float, *_: float) -> float:
        total = 0.0
        for samples, low in zip(sides, (-tilt, tilt), strict=True):
            horizon = math.sin(min(math.asin(low) + p.bias, math.pi / 2))
            for elevation, distance in samples:
                weight = (1 - (distance / p.radius) ** 2) / p.falloff
                if weight > 0 and elevation > horizon:
                    total += min(weight, 1) * (elevation - horizon)
                    horizon = elevation
        return total

    for view in (rubble(16), rubble(8)):
        sums = loops(view, 3, 5, p, pair)
        expected = np.clip(1 - p.intensity * sums / 6, 0, 1) ** p.power
        alike(shaded(hbao.hbao(6, 5, p), view), expected, view)


def test_gtao_is_the_cosine_weighted_arc_between_its_horizons() -> None:
    p = UNEVEN

    def arc(sides: list[list[tuple[float, float]]], tilt: float, length: float) -> float:
        normal = math.asin(max(-1.0, min(1.0, tilt)))
        angles = []
        for samples, low, sign in zip(sides, (-tilt, tilt), (1, -1), strict=True):
            horizon = low
            for elevation, distance in samples:
                weight = max(0.0, min(1.0, (1 - distance / p.radius) / p.falloff))
                horizon = max(horizon, low + weight * (elevation - p.bias - low))
            angles.append(sign * math.acos(max(-1.0, min(1.0, horizon))))
        # ∫ of cos(θ - normal) |sin θ| from the eye's ray to either horizon, by quadrature
        steps = (np.arange(4000) + 0.5) / 4000
        return length * sum(
            float(np.mean(np.cos(h * steps - normal) * np.abs(np.sin(h * steps))) * abs(h))
            for h in angles
        )

    for view in (rubble(16), rubble(8)):
        visible = loops(view, 3, 5, p, arc) / 3
        expected = np.clip(1 + (visible - 1) * p.intensity, 0, 1) ** p.power
        alike(shaded(gtao.gtao(3, 5, p), view), expected, view)


def alike(image: Float, expected: Float, view: View) -> None:
    assert image[~view.background].std() > 0.01
    apart = np.abs(image - expected)[~view.background]
    assert np.mean(apart > 2e-3) < 0.02  # a sample between two pixels may round to either
    assert apart.mean() < 2e-3


def loops(view: View, count: int, steps: int, p: Any, side_sum: Callable[..., float]) -> Float:
    """(H, W): over each pixel's slices the sum of what their samples, near to far, add up to."""
    position = view.attributes["position"].astype(float) / view.radius
    height, width = view.background.shape
    sums = np.zeros((height, width))
    jitter = screen.jitter(*np.meshgrid(np.arange(width), np.arange(height)))
    for row, column in zip(*np.nonzero(~view.background), strict=True):
        here, normal = position[:, row, column], view.attributes["normal"][:, row, column]
        normal = normal / np.linalg.norm(normal)
        eye = -here / np.linalg.norm(here)
        turn, offset = (float(plane[row, column]) for plane in jitter)
        for index in range(count):
            angle = (turn + index) * math.pi / count
            screen_way = np.array([math.cos(angle), math.sin(angle), 0])
            way = screen_way - eye * (screen_way @ eye)
            way /= np.linalg.norm(way)
            ahead, up = normal @ way, max(normal @ eye, 0)
            length = math.hypot(ahead, up)
            sides: list[list[tuple[float, float]]] = [[], []]
            for step in range(steps):
                share = ((offset + (index + step * steps) * screen.GOLDEN) % 1 + step) / steps
                pixels = (
                    share**p.spread * p.radius * view.camera.pixels_per_unit / -here[2]
                    + screen.NEAREST
                )
                for samples, sign in zip(sides, (1, -1), strict=True):
                    c = round(column + sign * pixels * screen_way[0])
                    r = round(row - sign * pixels * screen_way[1])
                    if not (0 <= c < width and 0 <= r < height) or view.background[r, c]:
                        continue
                    delta = position[:, r, c] - here
                    distance = float(np.linalg.norm(delta))
                    samples.append((float(delta @ eye) / distance, distance))
            sums[row, column] += side_sum(sides, ahead / length, length)
    return sums
