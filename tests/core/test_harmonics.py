"""Spherical harmonics, against SciPy's and orthonormality."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import sph_harm_y

from deepshade.environments import Environment, directions, solid_angles, world_to_map
from deepshade.environments.harmonics import COUNT, harmonics, projected


def test_they_are_scipys_without_its_phase() -> None:
    x, y, z = directions(5, 10)
    theta, phi = np.arccos(z), np.arctan2(y, x)
    found = harmonics(x, y, z)
    assert len(found) == COUNT
    for degree in range(4):
        for order in range(-degree, degree + 1):
            complex_one = (-1.0) ** order * sph_harm_y(degree, abs(order), theta, phi)
            part = complex_one.real if order >= 0 else complex_one.imag
            expected = part if order == 0 else np.sqrt(2) * part
            assert found[degree * degree + degree + order] == pytest.approx(expected)


def test_a_map_of_harmonics_has_its_coefficients_also_turned() -> None:
    """Orthonormality; a turned map's coefficients give the same light in turned directions."""
    wave = np.stack(harmonics(*directions(64, 128)))
    coefficients = np.random.default_rng(1).normal(size=(3, COUNT))
    coefficients[:, 0] = 20
    environment = Environment("smooth", np.einsum("ck,khw->chw", coefficients, wave))
    assert projected(environment) == pytest.approx(coefficients, abs=0.02)
    turn = world_to_map(70.0, "z")
    rows = np.stack(harmonics(*directions(4, 8)))
    there = np.einsum("ck,khw->chw", projected(environment, turn), rows)
    assert there == pytest.approx(environment.sample(directions(4, 8), turn), abs=0.03)


def test_white_has_the_first_alone() -> None:
    found = projected(Environment("white", np.ones((3, 16, 32), np.float32)))
    assert found[:, 0] == pytest.approx(np.sqrt(4 * np.pi))
    assert np.abs(found[:, 1:]).max() < 0.05
    assert solid_angles(16, 32).sum() * 32 == pytest.approx(4 * np.pi)
