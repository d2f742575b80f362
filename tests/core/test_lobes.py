"""The table of blurred environments, against sums over the map in float64."""

import math

import numpy as np
import pytest

from deepshade.environments import Environment, directions, sky, solid_angles
from deepshade.environments.lobes import HEIGHT, LEVELS, TILES, WIDTH, prefilter

RANDOM = np.random.default_rng(3)


def tile(table, index):
    at = TILES[index]
    return table[:, at.row : at.row + at.rows, at.column : at.column + 2 * at.rows]


def blurred(environment, towards, exponent):
    """A(d, m) by summing over all pixels."""
    grid, weights = directions(*environment.shape), solid_angles(*environment.shape)[:, None]
    lobe = np.maximum(np.tensordot(towards, grid, axes=1), 0) ** exponent * weights
    return (environment.radiance * lobe).sum((1, 2)) * (exponent + 1) / (2 * math.pi)


@pytest.fixture(scope="module")
def made():
    noise = RANDOM.gamma(0.3, size=(3, 16, 32)).repeat(32, 1).repeat(32, 2).astype(np.float32)
    noise[:, 140, 37] = 5e4  # and a sun
    environment = Environment("noise", noise)
    return environment, prefilter(environment)


def test_tiles_do_not_overlap():
    taken = np.zeros((HEIGHT, WIDTH), int)
    for at in TILES:
        taken[at.row - 1 : at.row + at.rows + 1, at.column - 1 : at.column + 2 * at.rows + 1] += 1
    assert taken.max() == 1
    assert taken.sum() == sum((at.rows + 2) * (2 * at.rows + 2) for at in TILES)


@pytest.mark.slow
def test_every_exponent_is_the_sum_over_the_map(made):
    environment, table = made
    for level in range(LEVELS):
        at, errors, sizes = TILES[level + 1], [], []
        for row in {0, at.rows // 3, at.rows - 1, *RANDOM.integers(at.rows, size=4)}:
            column = RANDOM.integers(2 * at.rows)
            towards = directions(at.rows, 2 * at.rows)[:, row, column]
            expected = blurred(environment, towards, 2.0**level)
            errors.append(np.abs(tile(table, level + 1)[:, row, column] - expected))
            sizes.append(expected)
        assert np.mean(errors) < 0.01 * np.mean(sizes)


def test_mean_and_map_are_there_too(made):
    environment, table = made
    np.testing.assert_allclose(tile(table, 0)[:, 0, 0], environment.mean, rtol=1e-6)
    # the map has half as many rows as its tile, so its pixels lie between four of them
    between = tile(table, -1).reshape(3, 512, 2, 1024, 2).mean((2, 4))
    inner = np.s_[:, 200:300, 100:900]
    np.testing.assert_allclose(between[inner], environment.radiance[inner], rtol=0.5, atol=1)
    assert np.abs(between[inner] - environment.radiance[inner]).mean() < 0.05


@pytest.mark.parametrize("height", [1, 3, 512, 700])
def test_white_stays_white_at_any_size(height):
    table = prefilter(Environment("", np.full((3, height, 2 * height), 0.7, np.float32)))
    for index in range(len(TILES)):
        np.testing.assert_allclose(tile(table, index), 0.7, rtol=1e-5)


def test_nothing_is_brighter_than_the_map(made):
    environment, table = made
    assert table.max() <= environment.radiance.max()
    assert table.min() >= 0


def test_a_large_map_is_as_a_small_one():
    """2048 rows and 512 of the same sky: the sun is where it was, and as strong."""
    small = sky(height=512, elevation=40)
    fine = prefilter(Environment("", small.radiance.repeat(4, 1).repeat(4, 2)))
    usual = prefilter(small)
    for index in range(1, len(TILES) - 1):
        error = np.abs(tile(fine, index) - tile(usual, index))
        assert error.mean() < 2e-3 * tile(usual, index).mean()


def test_borders_go_on_around_the_sphere(made):
    _, table = made
    at = TILES[5]
    picture = tile(table, 5)
    left = table[:, at.row : at.row + at.rows, at.column - 1]
    np.testing.assert_array_equal(left, picture[:, :, -1])
    above = table[:, at.row - 1, at.column : at.column + 2 * at.rows]
    np.testing.assert_array_equal(above, np.roll(picture[:, 0], at.rows, axis=1))
