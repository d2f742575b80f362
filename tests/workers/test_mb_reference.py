"""Motion blur against ramps, and what the attribute says of motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera
from deepshade_workers.attributes import make_attributes
from deepshade_workers.references import mb
from deepshade_workers.scenes.mesh import Material, merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import Light, View

from .conftest import quad

SIZE = 32
# The lamp is far and low on the left, so that shadows fall beyond what is seen.
LAMP = Light((-100.0, 60.0, 0.0), 0.0, (1e4,) * 3, (0.5,) * 3, (0.5,) * 3, (0.5,) * 3)
CAMERA = Camera.look_at((0, 4, 0), (0, 0, 0), (0, 0, -1), 60, SIZE, SIZE)
PIXEL = 4 / CAMERA.pixels_per_unit  # at the floor


def flat(center: Any, half: Any, diffuse: float) -> Any:
    shape = quad(center, (half[0], 0, 0), (0, 0, -half[1]))
    shape.materials[:] = Material(diffuse=(diffuse,) * 3, specular=(0, 0, 0)).row()
    return shape


def rendered(
    parts: dict[str, Any], moves: dict[str, Any], *, samples: int = 64, seed: int = 1
) -> Any:
    """(H, W) value, error, L and (2, H, W) F of one channel."""
    scene = Scene.from_mesh("scene", merge(parts.values(), tuple(parts)))
    view = View(CAMERA, 1.0, shutter=1.0, displacements=moves, light=LAMP)
    hits = trace(scene, CAMERA, SIZE, SIZE)
    images = make_attributes(scene, view, hits, ("light", "motion"), seed=1, samples=256)
    value, error = mb.reference(scene, view, hits, images, samples=samples, seed=seed)
    return value[0], error[0], images["light"][0], images["motion"]


def covered(shift: float, half: float, speed: float) -> np.ndarray:
    """How long a bar of ± `half` pixels about `shift` that moves `speed` covers each column."""
    x = np.arange(SIZE) + 0.5 - SIZE / 2 - shift
    low, high = (-half - x) / speed, (half - x) / speed  # t at which each end passes, negated
    low, high = np.minimum(low, high), np.maximum(low, high)
    return np.clip(np.minimum(high, 0.5) - np.maximum(low, -0.5), 0, 1)


@pytest.mark.parametrize("speed", [9.0, -9.0, 1.5])
def test_a_bar_over_the_sky_is_the_analytic_ramp(speed: float) -> None:
    parts = {"bar": flat((0, 0, 0), (4 * PIXEL, 9), 0.6)}
    value, error, light, motion = rendered(parts, {"bar": (speed * PIXEL, 0, 0)})
    bar, sky = light[16, 16], light[16, 0]
    share = covered(0, 4, speed)
    assert sky == 0.5
    # the lamp is far, so that L is even but for the noise of the sky's part
    residual = value - (share * bar + (1 - share) * sky)
    assert (np.abs(residual.mean(0)) <= 3 * np.sqrt((error**2).mean(0) / SIZE) + 2e-3).all()
    assert np.allclose(motion[:, 16, 16], (speed, 0), atol=1e-3)


def test_both_directions_give_the_same_picture_and_rest_gives_the_light() -> None:
    parts = {
        "floor": flat((0, 0, 0), (9, 9), 0.2),
        "bar": flat((0, 1, 0), (0.5, 0.8), 0.9),
    }
    forth, back, rest = (
        rendered(parts, {"bar": (s, 0, 0.5 * s)}, seed=seed)
        for seed, s in enumerate((1.2, -1.2, 0.0))
    )
    # An edge passes in one stratum of time, whose single pair tells little: so the mean of many.
    difference, variance = forth[0] - back[0], forth[1] ** 2 + back[1] ** 2
    assert (difference**2).mean() == pytest.approx(variance.mean(), rel=0.3)
    assert abs(difference.mean()) <= 3 * np.sqrt(variance.mean()) / SIZE
    assert np.abs(forth[0] - rest[0]).max() > 0.1
    assert (np.abs(rest[0] - rest[2]) <= 4.5 * rest[1] + 0.02).all()
    assert np.abs((rest[0] - rest[2]).mean()) < 1e-3
    assert (rest[3] == 0).all()


def test_near_moves_over_far_and_far_behind_near() -> None:
    half = PIXEL / 2  # at height 2 a pixel is half as wide
    parts = {
        "far": flat((0, 0, 0), (4 * PIXEL, 9), 0.1),
        "near": flat((8 * half, 2, 0), (4 * half, 9), 0.9),
    }
    for name, speed in (("near", 6 * half), ("far", 6 * PIXEL)):
        value, error, light, _ = rendered(parts, {name: (speed, 0, 0)}, samples=256)
        far, near, sky = light[16, 16], light[16, 24], light[16, 0]
        at_near = covered(8, 4, 6.0 if name == "near" else 1e-6)
        at_far = covered(0, 4, 6.0 if name == "far" else 1e-6)
        # what moves and what rests are independent: one of both shares is 0 or 1
        expected = at_near * near + (1 - at_near) * (at_far * far + (1 - at_far) * sky)
        residual = np.abs((value - expected).mean(0))
        # a bar casts a shadow of the sky on the other: 2 % of L
        assert (residual <= 3 * np.sqrt((error**2).mean(0) / SIZE) + 0.02).all()


def test_parts_keep_their_materials_and_shadows_stay_where_they_are() -> None:
    """Under a lamp alone L has no noise: a shadow of the middle stays on the floor at all times."""
    parts = {
        "floor": flat((0, 0, 0), (9, 9), 0.5),
        "high": flat((0, 3.5, 0), (0.05, 0.05), 0.5),
    }
    scene = Scene.from_mesh("scene", merge(parts.values(), tuple(parts)))
    dark = (0.0, 0.0, 0.0)
    lamp = Light((1.0, 5.0, 0.0), 0.0, (9.0,) * 3, dark, dark, dark)
    view = View(CAMERA, 1.0, displacements={"high": (0.2, 0, 0)}, light=lamp)
    hits = trace(scene, CAMERA, SIZE, SIZE)
    images = make_attributes(scene, view, hits, ("light", "motion"), seed=1)
    value, error = mb.reference(scene, view, hits, images, samples=32, seed=1)
    still = error[0] == 0
    assert 0.6 < still.mean() < 1
    assert np.allclose(value[0][still], images["light"][0][still], rtol=1e-4)
    assert (images["light"][0][still] == 0).sum() >= 1  # some of the shadow


def test_an_object_moves_by_what_the_attribute_says() -> None:
    """At both ends of the exposure a corner of the bar lies half of F from where it is."""
    parts = {"bar": flat((0, 1, 0), (0.5, 0.5), 0.9)}
    value, _, _, motion = rendered(parts, {"bar": (0.9, 0, -0.6)}, samples=512)
    u, v = motion[:, SIZE // 2, SIZE // 2]
    y, x = np.nonzero(value != value[0, 0])
    reach = 0.5 * CAMERA.pixels_per_unit / 3  # half the bar at its depth of 3
    for found, moved in ((x, u), (y, v)):
        extent = found.max() - found.min() + 1
        assert extent == pytest.approx(2 * reach + abs(moved), abs=1.01)
