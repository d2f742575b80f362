"""Importance sampling of environment maps, against the maps themselves."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade.environments import Environment, directions, solid_angles, world_to_map
from deepshade_workers.backend import mitsuba
from deepshade_workers.environments import EnvironmentLight
from deepshade_workers.maps import reduced

mi = mitsuba()

COUNT = 2**16


def noisy(sun: float = 300.0) -> Environment:
    """Random colours and a sun of one pixel, near the right edge."""
    radiance = np.random.default_rng(3).random((3, 16, 32)).astype(np.float32)
    radiance[:, 4, 30] = sun
    return Environment("noisy", radiance)


def fine() -> tuple[np.ndarray, np.ndarray]:
    """(3, N) directions all around and (N,) their solid angles."""
    solid = np.broadcast_to(solid_angles(512, 1024)[:, None], (512, 1024))
    return directions(512, 1024).reshape(3, -1), solid.ravel()


@pytest.mark.parametrize("rotation", [0.0, -70.0, 1000.0])
def test_radiance_is_that_of_the_map(rotation: float) -> None:
    toward = np.random.default_rng(1).normal(size=(3, 4000))
    toward[:, :4] = np.hstack([np.eye(3)[:, ::2], -np.eye(3)[:, ::2]])
    toward[:, 4:6] = [[1e-3, 0], [1, -1], [0, 1e-3]]  # at a pole itself all columns meet
    toward /= np.linalg.norm(toward, axis=0)
    light = EnvironmentLight.of(noisy(), rotation)
    found = light.radiance(mi.Vector3f(toward.astype(np.float32))).numpy()
    expected = noisy().sample(toward, world_to_map(rotation))
    assert found == pytest.approx(expected, abs=2e-3)
    assert light.mean.numpy().ravel() == pytest.approx(noisy().mean)


@pytest.mark.parametrize("rotation", [0.0, 200.0])
def test_directions_follow_their_density(rotation: float) -> None:
    """Means of harmonic-like functions over drawn directions are the integrals of the density."""
    light = EnvironmentLight.of(noisy(20.0), rotation)
    toward, solid = fine()
    density = light.density(mi.Vector3f(toward.astype(np.float32))).numpy() * solid
    assert density.sum() == pytest.approx(1, abs=1e-3)
    pairs = np.random.default_rng(2).random((2, COUNT)).astype(np.float32)
    drawn = light.sample(mi.Point2f(pairs)).numpy().astype(np.float64)
    assert np.linalg.norm(drawn, axis=0) == pytest.approx(1, abs=1e-5)

    def functions(d: np.ndarray) -> np.ndarray:
        x, y, z = d
        return np.stack([x, y, z, x * y, y * z, x * z, x * x, y * y, x**3, y**3, z**3, x * y * z])

    values = functions(drawn)
    error = values.std(1) / np.sqrt(COUNT)
    assert (np.abs(values.mean(1) - functions(toward) @ density) < 4 * error + 1e-4).all()


def test_light_over_density_is_nearly_even() -> None:
    """Its mean is the integral; a sun three thousand times the rest adds little to its spread."""
    light = EnvironmentLight.of(noisy(3000.0))
    pairs = np.random.default_rng(2).random((2, COUNT)).astype(np.float32)
    drawn = light.sample(mi.Point2f(pairs))
    ratio = (light.radiance(drawn) / light.density(drawn)).numpy().astype(np.float64)
    toward, solid = fine()
    total = noisy(3000.0).sample(toward).astype(np.float64) @ solid
    error = ratio.std(1) / np.sqrt(COUNT)
    assert (np.abs(ratio.mean(1) - total) < 4 * error + 1e-4 * total).all()
    assert (ratio.std(1) < 0.3 * total).all()


def test_a_black_map_is_sampled_too() -> None:
    light = EnvironmentLight.of(Environment("black", np.zeros((3, 16, 32), np.float32)))
    drawn = light.sample(mi.Point2f(np.random.default_rng(2).random((2, 64)).astype(np.float32)))
    assert np.isfinite(drawn.numpy()).all()
    assert (light.density(drawn).numpy() > 0).all()
    assert (light.radiance(drawn).numpy() == 0).all()


@pytest.mark.parametrize("height", [8, 11])
def test_a_reduced_map_keeps_its_light(height: int) -> None:
    big = noisy()
    small = reduced(big, height)
    assert small.shape == (height, 2 * height)
    assert small.mean == pytest.approx(big.mean, rel=1e-5)
    sun = np.unravel_index(small.radiance[0].argmax(), small.shape)
    assert sun == (int(4.5 / 16 * height), int(30.5 / 32 * 2 * height))
    assert reduced(big, 16) is big
