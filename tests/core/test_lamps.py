"""Environments as lamps, against integrals over the map."""

import numpy as np

from deepshade.environments import Environment, directions, solid_angles
from deepshade.environments.lamps import DIRECTIONS, fibonacci, gathered, lamps, nearest


def test_the_directions_are_even():
    """From everywhere the same light falls: (1/π)∫ cosθ dω = 1, within half a percent."""
    assert DIRECTIONS.shape == (512, 3)
    np.testing.assert_allclose(np.linalg.norm(DIRECTIONS, axis=1), 1)
    received = np.maximum(fibonacci(100) @ DIRECTIONS.T, 0).sum(1) * 4 / len(DIRECTIONS)
    np.testing.assert_allclose(received, 1, atol=5e-3)


def test_lamps_hold_all_of_the_light_and_a_sun_keeps_its_place():
    radiance = np.random.default_rng(1).random((3, 32, 64)).astype(np.float32)
    radiance[:, 7, 11] = 1e5
    toward, light = lamps(Environment("", radiance), 400)
    weights = solid_angles(32, 64)[:, None]
    np.testing.assert_allclose(light.sum(0), (radiance * weights).sum((1, 2)), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 1)
    sun = light.sum(1).argmax()
    assert toward[sun] @ directions(32, 64)[:, 7, 11] > np.cos(np.radians(0.1))


def test_lamps_where_no_pixel_lies_are_dark():
    toward, light = lamps(Environment("", np.ones((3, 4, 8), np.float32)), 300)
    assert (light == 0).all(1).sum() == 300 - 32
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), 1)


def test_gathered_light_is_that_of_the_nearest():
    points = fibonacci(50)
    chosen = nearest(points[[3, 7, 3]], points)
    assert chosen.tolist() == [3, 7, 3]
    found = gathered(np.arange(6.0).reshape(3, 2), chosen, 50)
    assert found[3].tolist() == [0 + 4, 1 + 5]
    assert found.sum() == 15
