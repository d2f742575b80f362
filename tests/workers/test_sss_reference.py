"""Subsurface scattering against the profile's closed forms, a convolution and brute force."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from scipy.integrate import quad as integral

from deepshade.camera import Camera
from deepshade_workers.attributes import make_attributes
from deepshade_workers.references import sss
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import mi, trace
from deepshade_workers.view import View

from .conftest import quad


def profile(r: Any, d: Any) -> Any:
    return (np.exp(-r / d) + np.exp(-r / (3 * d))) / (8 * np.pi * d * r)


def prepared(scene: Scene, camera: Camera, path: Any) -> Any:
    """The view, hits and images, lit by 1, with the mean free `path` of each channel."""
    view = View(camera, 1.0)
    hits = trace(scene, camera, camera.width, camera.height)
    images = make_attributes(scene, view, hits, ("position",), seed=1)
    plane = np.ones((1, camera.height, camera.width), np.float32)
    images["scatter"] = plane * np.array(path, np.float32).reshape(-1, 1, 1)
    images["light"] = plane.repeat(3, 0)
    return view, hits, images


@pytest.fixture(scope="module")
def floor() -> Scene:
    return Scene.from_mesh("floor", quad((0, 0, 0), (500, 0, 0), (0, 0, -500)))


@pytest.mark.parametrize("d", [1e-3, 0.7, 40.0])
def test_the_profile_integrates_to_one(d: float) -> None:
    inner = float(sss.within(mi.Float(0.5 * d), mi.Float(d))[0])
    radius = mi.Float(0.37 * d)
    assert float(sss.profile(radius, mi.Float(d))[0]) == pytest.approx(profile(0.37 * d, d), 1e-5)
    disc, _ = integral(lambda r: profile(r, d) * 2 * np.pi * r, 0, 0.5 * d)
    rest, _ = integral(lambda r: profile(r, d) * 2 * np.pi * r, 0.5 * d, 100 * d)
    assert inner == pytest.approx(disc, rel=1e-5)
    assert disc + rest == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("away", "u", "v"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (1, 0, 0), (0.5, 8, 0)),
        ((1, 0, 0), (1, 0, 0), (0, 12, 0)),
        ((1, 1, 0), (1, 0.2, 0), (0, 1, 0)),
        ((1, 0, 0.4), (1, 0, 0.3), (0, 1, 0.9)),
    ],
)
@pytest.mark.parametrize("d", [0.3, 5.0])
def test_outlines_hold_what_a_fine_sum_over_them_does(away: Any, u: Any, v: Any, d: float) -> None:
    cells = 1000
    t = (np.arange(cells) + 0.5) / cells - 0.5
    steps, width = 4 * t**3, 12 * t**2 / cells  # dense in the middle, where R may be singular
    a, b = steps[:, None, None], steps[None, :, None]
    r = np.linalg.norm(np.array(away) + a * np.array(u) + b * np.array(v), axis=-1)
    area = np.linalg.norm(np.cross(u, v)) * width[:, None] * width
    expected = (profile(r, d) * area).sum()
    found = sss.over_outline(*(mi.Vector3f(*x) for x in (away, u, v)), mi.Color3f(d))
    assert dr.slice(found[0], 0) == pytest.approx(expected, rel=5e-4)


def test_constant_light_stays_and_so_does_what_cannot_scatter(floor: Scene, down: Camera) -> None:
    view, hits, images = prepared(floor, down, (0.3, 0.01, 0))
    images["light"] *= np.array([3, 1e5, 1], np.float32).reshape(3, 1, 1)
    images["light"][2] = np.random.default_rng(1).random((32, 32))
    value, error = sss.reference(floor, view, hits, images, samples=8, seed=1)
    assert (value == images["light"]).all()
    assert (error == 0).all()


def test_a_vanishing_path_gives_the_light(floor: Scene, down: Camera) -> None:
    view, hits, images = prepared(floor, down, (1e-3, 1e-6, 1e-30))
    images["light"] = np.random.default_rng(1).random((3, 32, 32)).astype(np.float32)
    value, error = sss.reference(floor, view, hits, images, samples=8, seed=1)
    # the first is of .02 pixel, which leaves exp(-9) beyond the pixel's sides
    assert np.allclose(value[0], images["light"][0], atol=1e-3)
    assert np.allclose(value[1:], images["light"][1:], atol=1e-6)
    assert (error[1:] < 1e-6).all()


def step_response(x: np.ndarray, d: float) -> np.ndarray:
    """R's share on a plane beyond a straight edge at the signed distance x of the receiver."""

    def half(distance: float) -> float:
        def beyond(r: float) -> float:
            rate = (np.exp(-r / d) + np.exp(-r / (3 * d))) / (4 * d)
            return rate * np.arccos(distance / r) / np.pi

        return integral(beyond, distance, distance + 80 * d)[0]

    return np.array([half(s) if s >= 0 else 1 - half(-s) for s in x.tolist()])


@pytest.mark.slow
@pytest.mark.parametrize("eye", [(0, 2, 1e-3), (0, 1, 2.2)])
def test_a_step_of_light_on_a_plane_is_convolved_in_space(floor: Scene, eye: Any) -> None:
    """From above and at 24 degrees: distances and areas are the surface's, not the picture's."""
    camera = Camera.look_at(eye, (0, 0, 0), (0, 0, -1), 60, 64, 64)
    d = 0.04
    view, hits, images = prepared(floor, camera, (d, d, d))
    points = hits.p.numpy().reshape(3, 64, 64)
    images["light"] = np.stack([points[0] > 0, points[2] > 0, points[2] > 0]).astype(np.float32)
    value, error = sss.reference(floor, view, hits, images, samples=256, seed=1)
    middle = slice(24, 40)  # far from what the picture doesn't show
    for channel, axis in ((0, 0), (1, 2)):
        at = points[axis][middle, middle]
        # pixels are lit or not as a whole: the edge lies between them, along rows and columns
        line = at.mean(1 if axis else 0)
        border = 0.5 * (line[line > 0].min() + line[line < 0].max())
        expected = step_response(border - line, d)
        residual = value[channel][middle, middle].mean(1 if axis else 0) - expected
        sigma = np.sqrt((error[channel][middle, middle] ** 2).mean(1 if axis else 0))
        assert (np.abs(residual) <= 3 * sigma / 4 + 0.01).all()


def brute(view: View, hits: Any, images: Any, fine: int) -> np.ndarray:
    """The definition, with each footprint in fine x fine parts."""
    position = images["position"].astype(np.float64)
    u, v = (side.astype(np.float64) for side in sss.footprints(view, hits, images["position"]))
    area = np.linalg.norm(np.cross(u, v, axis=0), axis=0)
    there = hits.valid.numpy().reshape(area.shape)
    light, scatter = images["light"].astype(np.float64), images["scatter"]
    result = light.copy()
    t = (np.arange(fine) + 0.5) / fine - 0.5
    steps, width = 4 * t**3, 12 * t**2 / fine  # dense about the receiver
    parts = np.stack([position + a * u + b * v for a in steps for b in steps])
    shares = np.outer(width, width).reshape(-1, 1, 1)
    for y, x in zip(*np.nonzero(there), strict=True):
        r = np.linalg.norm(parts - position[:, y, x, None, None], axis=1)
        for c in range(3):
            d = scatter[c, y, x]
            if d > 0:
                weight = (shares * profile(r, d)).sum(0) * area * (there & (scatter[c] > 0))
                result[c, y, x] = (weight * light[c]).sum() / weight.sum()
    return result


@pytest.mark.slow
def test_a_picture_with_steps_slopes_and_sky_equals_brute_force() -> None:
    parts = [
        quad((0, 0, 0), (1, 0, 0), (0, 0, -1)),
        quad((0.2, 0.4, 0), (0.4, 0, 0), (0, 0.3, -0.2)),
        quad((-0.5, 0.2, -0.3), (0.1, 0.2, 0), (0, 0.1, -0.3)),
    ]
    scene = Scene.from_mesh("steps", merge(parts))
    camera = Camera.look_at((0.3, 1.5, 1.2), (0, 0.1, 0), (0, 1, 0), 80, 20, 16)
    view, hits, images = prepared(scene, camera, (0.05, 0.3, 2.0))
    random = np.random.default_rng(1)
    images["light"] = random.random((3, 16, 20)).astype(np.float32)
    images["scatter"] *= random.random((3, 16, 20)) > 0.2
    runs = [sss.reference(scene, view, hits, images, samples=512, seed=s) for s in range(4)]
    expected = brute(view, hits, images, 16)
    residual = np.mean([value for value, _ in runs], 0) - expected
    sigma = np.sqrt(np.mean([error**2 for _, error in runs], 0) / 4)
    assert (np.abs(residual) <= 4 * sigma + 1e-3).all()
    assert (np.abs(residual) <= 3 * sigma + 1e-3).mean() > 0.99
    assert sigma.max() < 0.02
    # the claimed error is the spread of repeated renders
    spread = np.var([value for value, _ in runs], 0, ddof=1).mean()
    assert spread == pytest.approx(4 * (sigma**2).mean(), rel=0.3)


def test_a_step_in_depth_isolates_and_a_larger_footprint_counts_more() -> None:
    """Two planes side by side in the picture: far apart in space they exchange no light."""
    camera = Camera.look_at((0, 2, 0), (0, 0, 0), (0, 0, -1), 50, 32, 32)

    def blurred(left: float) -> Any:
        parts = [quad((5, 0, 0), (5, 0, 0), (0, 0, -9)), quad((-9, left, 0), (9, 0, 0), (0, 0, -9))]
        scene = Scene.from_mesh("two", merge(parts))
        view, hits, images = prepared(scene, camera, (0.1, 0.1, 0.1))
        assert (hits.p.numpy()[0].reshape(32, 32)[:, 17] > 0).all()
        images["light"][:, :, :16] = 0
        return sss.reference(scene, view, hits, images, samples=64, seed=1)[0][0, :, 17].mean()

    assert blurred(0.0) < 0.8
    assert blurred(-6.0) > 0.999
