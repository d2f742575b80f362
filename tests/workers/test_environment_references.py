"""Directional occlusion, image-based lighting and full shading, against closed forms, quadrature
and each other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from deepshade.camera import Camera, rotation_of
from deepshade.environments import Environment, directions, solid_angles, world_to_map
from deepshade.environments.harmonics import harmonics
from deepshade.errors import ConfigError
from deepshade_workers.environments import EnvironmentLight
from deepshade_workers.references import ao, do, full, ibl
from deepshade_workers.scenes.mesh import merge
from deepshade_workers.scenes.procedural.primitives import place, sphere
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, trace
from deepshade_workers.view import View

from .conftest import assert_within, matte, quad

SIDE = 16
HEIGHT, WIDTH = 16, 32  # of all maps: one size, one kernel


def filled(value: float = 1.0) -> np.ndarray:
    return np.full((3, HEIGHT, WIDTH), value, np.float32)


def noise(seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).random((3, HEIGHT, WIDTH)).astype(np.float32)


def sun(row: int = 4, column: int = 24, strength: float = 1000.0, rest: float = 0.0) -> np.ndarray:
    """One bright pixel; by default 39° from the zenith, in +x."""
    radiance = filled(rest)
    radiance[:, row, column] = strength
    return radiance


def smooth(seed: int = 5) -> np.ndarray:
    """Of harmonics up to degree 3."""
    coefficients = np.random.default_rng(seed).normal(size=(3, 16))
    coefficients[:, 0] = 20
    return np.einsum("ck,khw->chw", coefficients, np.stack(harmonics(*directions(HEIGHT, WIDTH))))


def under(radiance: np.ndarray, camera: Camera, *, rotation: float = 0.0, **settings: Any) -> View:
    light = EnvironmentLight.of(Environment("map", radiance), rotation)
    return View(camera, settings.pop("radius", 1.0), surroundings=light, **settings)


def rendered(module: Any, scene: Scene, view: View, *, samples: int = 256, seed: int = 1) -> Any:
    hits = trace(scene, view.camera, view.camera.width, view.camera.height)
    return module.reference(scene, view, hits, {}, samples=samples, seed=seed)


def coated(mesh: Any, diffuse: float, specular: float, gloss: float) -> Any:
    mesh.materials[:, :7] = (*[diffuse] * 3, *[specular] * 3, gloss)
    return mesh


@pytest.fixture(scope="module")
def above() -> Camera:
    """Looks into the corner of `conftest.corner`."""
    return Camera.look_at((0.2, 2, 0.5), (0, 0, -0.6), (0, 1, 0), 30, SIDE, SIDE)


@pytest.fixture(scope="module")
def ahead() -> Camera:
    return Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 45, SIDE, SIDE)


def ball(diffuse: float, specular: float, gloss: float) -> Scene:
    mesh = sphere(4).transformed(place(size=2.0))
    return Scene.from_mesh("ball", coated(mesh, diffuse, specular, gloss))


# --- directional occlusion


def test_under_white_it_is_ambient_occlusion(corner: Scene, above: Camera) -> None:
    view = under(filled(), above)
    value, error = rendered(do, corner, view)
    expected, also = rendered(ao, corner, view, samples=1024, seed=2)
    assert expected.std() > 0.05
    for channel in range(3):
        sigma = np.hypot(error[channel], also[0])
        assert_within(value[channel], sigma, expected[0])


def test_it_is_linear_in_the_map(corner: Scene, above: Camera) -> None:
    one, two = noise(1), sun(strength=50.0)
    (a, ea), (b, eb), (both, e), (scaled, _) = (
        rendered(do, corner, under(radiance, above), seed=seed)
        for seed, radiance in enumerate((one, two, one + two, 4 * (one + two)), 2)
    )
    assert_within(both, np.sqrt(e**2 + ea**2 + eb**2), a + b)
    again, _ = rendered(do, corner, under(4 * (one + two), above), seed=4)
    assert again == pytest.approx(4 * both, rel=1e-5)
    assert not np.array_equal(again, scaled)


@pytest.mark.parametrize(
    ("column", "rotation", "side"), [(24, 0.0, -1), (8, 0.0, 1), (24, 180.0, 1), (16, -90.0, -1)]
)
def test_a_post_throws_its_shadow_away_from_the_light(
    column: int, rotation: float, side: int, down: Camera
) -> None:
    """Light of one direction; columns right of the centre are +x, turns are counter-clockwise."""
    floor, wall = (
        quad((0, 0, 0), (9, 0, 0), (0, 0, -9)),
        quad((0, 0.25, 0), (0, 0.25, 0), (0, 0, 9)),
    )
    scene = Scene.from_mesh("post", merge([floor, wall]))
    camera = Camera.look_at((0, 3, 0), (0, 0, 0), (0, 0, -1), 20, SIDE, SIDE)
    view = under(sun(column=column), camera, rotation=rotation, radius=2.0)
    value, error = rendered(do, scene, view)
    hits = trace(scene, camera, SIDE, SIDE)
    x, y, _ = hits.p.numpy()
    x, value, error = x[y < 1e-3], value[0].ravel()[y < 1e-3], error[0].ravel()[y < 1e-3]
    dark, bright = side * x > 0.02, side * x < -0.02
    assert min(dark.sum(), bright.sum()) > 60
    # The pixel's tent is 22.5° wide: at 0.3 beside a wall of 0.5 all of it is hidden.
    assert (value[dark & (np.abs(x) < 0.3)] == 0).all()
    toward = directions(256, 512)
    turned = view.surroundings.environment.sample(toward, world_to_map(rotation))[0]
    open_ = (turned * np.maximum(toward[1], 0) * solid_angles(256, 512)[:, None]).sum() / np.pi
    assert_within(value[bright], error[bright], open_)


def test_a_sun_does_not_sparkle(corner: Scene, above: Camera) -> None:
    """Where it shines; the other part of the picture is lit by the weak rest."""
    light = under(sun(strength=1e5, rest=1.0), above)
    for module in (do, ibl):
        value, error = rendered(module, corner, light)
        lit = value[0] > np.median(value[0])
        assert (error[0][lit] < 0.2 * value[0][lit]).all()


def test_background_is_the_maps_mean(ahead: Camera) -> None:
    value, error = rendered(do, ball(0.5, 0, 1), under(noise(), ahead))
    corner_ = value[:, 0, 0], error[:, 0, 0]
    assert corner_[0] == pytest.approx(Environment("", noise()).mean, rel=1e-5)
    assert (corner_[1] == 0).all()


# --- image-based lighting


def test_a_white_furnace_gives_the_albedo(ahead: Camera) -> None:
    value, error = rendered(ibl, ball(0.6, 0, 1), under(filled(), ahead))
    on = error[0] > 0
    assert on.sum() > 100
    assert_within(value[0][on], error[0][on], 0.6)
    assert value[0][~on] == pytest.approx(1)


@pytest.mark.parametrize("gloss", [1.0, 100.0, 10000.0])
def test_a_mirror_seen_from_the_front_reflects_all_of_white(gloss: float) -> None:
    """(n + 2)/(2π) ∫ cosⁿ⁺¹ = 1."""
    camera = Camera.look_at((0, 0, 100), (0, 0, 0), (0, 1, 0), 0.5, SIDE, SIDE)
    wall = Scene.from_mesh("wall", coated(quad((0, 0, 0), (9, 0, 0), (0, 9, 0)), 0.2, 0.5, gloss))
    value, error = rendered(ibl, wall, under(filled(3.0), camera))
    assert_within(value, error, 2.1)


def mirrored(hits: Hits, camera: Camera) -> np.ndarray:
    """(3, N): the view's directions mirrored about the normals."""
    toward = camera.eye[:, None] - hits.p.numpy().astype(np.float64)
    toward /= np.linalg.norm(toward, axis=0)
    normal = hits.ns.numpy().astype(np.float64)
    return 2 * (toward * normal).sum(0) * normal - toward


def test_it_tends_to_the_mirror(ahead: Camera) -> None:
    off = []
    for gloss in (30.0, 10000.0):
        scene = ball(0.0, 0.8, gloss)
        hits = trace(scene, ahead, SIDE, SIDE)
        view = under(smooth(), ahead, rotation=20.0)
        value, _ = rendered(ibl, scene, view, samples=1024)
        expected = 0.8 * view.surroundings.environment.sample(
            mirrored(hits, ahead), world_to_map(20.0)
        )
        cosine = (mirrored(hits, ahead) * hits.ns.numpy()).sum(0)
        expected *= cosine  # what f = R (n + 2)/(2π) cosⁿα leaves of it
        # At grazing angles part of any lobe lies below the horizon.
        facing = hits.valid.numpy() & (cosine > 0.4)
        ratio = value.reshape(3, -1)[:, facing] / expected[:, facing]
        off.append(np.abs(ratio - 1).mean())
    assert off[1] < 0.01
    assert off[1] < 0.2 * off[0]


@pytest.mark.parametrize(
    ("radiance", "terms"),
    [(noise(), (0.5, 0.3, 20.0)), (sun(rest=1.0), (0.4, 0.4, 60.0)), (noise(), (0.0, 0.9, 3.0))],
)
def test_it_is_the_integral_over_the_map(
    radiance: np.ndarray, terms: tuple[float, float, float], ahead: Camera
) -> None:
    """A quadrature in float64 over all directions, for every pixel of a sphere."""
    scene = ball(*terms)
    view = under(radiance, ahead, rotation=-35.0)
    value, error = rendered(ibl, scene, view)
    hits = trace(scene, ahead, SIDE, SIDE)
    on = hits.valid.numpy()
    normal, lobe = hits.ns.numpy().astype(np.float64).T[on], mirrored(hits, ahead).T[on]
    toward = directions(128, 256)
    light = view.surroundings.environment.sample(toward, world_to_map(-35.0)).reshape(3, -1)
    light = light * np.repeat(solid_angles(128, 256), 256)
    cosine = np.maximum(normal @ toward.reshape(3, -1), 0)
    diffuse, specular, gloss = terms
    phong = specular * (gloss + 2) / (2 * np.pi)
    f = diffuse / np.pi + phong * np.maximum(lobe @ toward.reshape(3, -1), 0) ** gloss
    expected = (f * cosine) @ light.T
    for channel in range(3):
        plane = value[channel].ravel()[on], error[channel].ravel()[on]
        assert_within(*plane, expected[:, channel])


@pytest.mark.parametrize("terms", [(0.5, 0.5, 5.0), (0.0, 1.0, 300.0)])
def test_it_never_exceeds_the_maps_maximum(
    terms: tuple[float, float, float], ahead: Camera
) -> None:
    for radiance in (filled(2.0), sun(rest=0.5, strength=2.0)):
        value, error = rendered(ibl, ball(*terms), under(radiance, ahead))
        assert (value <= 2 + 4 * error + 1e-5).all()


# --- full shading


def test_with_a_closed_lens_it_is_ibl_times_ao(corner: Scene, above: Camera) -> None:
    view = under(sun(rest=0.5, strength=50.0), above, focus=2.0, aperture=0.0)
    value, error = rendered(full, corner, view)
    lit, el = rendered(ibl, corner, view, seed=2)
    open_, eo = rendered(ao, corner, view, seed=3)
    assert open_.std() > 0.05
    sigma = np.sqrt(error**2 + (el * open_) ** 2 + (eo * lit) ** 2)
    assert_within(value, sigma, lit * open_)


def test_the_environment_blurs_as_at_infinity(ahead: Camera) -> None:
    """Beside a speck the lens sees the map alone, in a disc of directions."""
    speck = Scene.from_mesh("speck", matte(quad((0, 0, -1e3), (1, 0, 0), (0, 1, 0))))
    view = under(noise(), ahead, rotation=-90.0, focus=2.0, aperture=1.2)
    value, error = rendered(full, speck, view)
    count = 4000
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    disc = 0.6 * np.sqrt((np.arange(count) + 0.5) / count) * np.stack([np.cos(turn), np.sin(turn)])
    rays = ahead.rays(SIDE, SIDE).astype(np.float64)[..., None].repeat(count, -1)
    rays[:2] -= disc[:, None, None] / 2.0
    rays /= np.linalg.norm(rays, axis=0)
    world = np.tensordot(rotation_of(ahead.matrix).T, rays, 1)
    seen = view.surroundings.environment.sample(world, world_to_map(-90.0)).mean(-1)
    away = np.ones((SIDE, SIDE), bool)
    away[4:12, 4:12] = False
    assert_within(value[:, away], error[:, away], seen[:, away])


@pytest.mark.slow
@pytest.mark.parametrize("module", [do, ibl, full])
def test_errors_are_the_spread_of_repeated_renders(
    module: Any, corner: Scene, above: Camera
) -> None:
    view = under(sun(rest=1.0, strength=100.0), above, focus=1.7, aperture=0.3)
    runs = [rendered(module, corner, view, samples=64, seed=seed) for seed in range(24)]
    spread = np.stack([value for value, _ in runs]).var(0, ddof=1).mean()
    claimed = np.stack([error**2 for _, error in runs]).mean()
    assert claimed == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize("module", [do, ibl, full])
def test_without_an_environment_there_is_none(module: Any, corner: Scene, above: Camera) -> None:
    with pytest.raises(ConfigError, match="needs an environment"):
        rendered(module, corner, View(above, 1.0))
