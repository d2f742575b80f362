"""What answers are judged beside: closed forms, and light that is judged alike at any exposure."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade import judging, metrics
from deepshade.effects import EFFECTS
from deepshade.environments import Environment, Surroundings, directions
from deepshade.errors import DataError


def test_the_trivial_answer_is_a_number_or_an_input() -> None:
    reference = np.zeros((3, 4, 5), np.float32)
    light = np.random.default_rng(0).random((3, 4, 5), np.float32)
    assert (judging.trivial(EFFECTS["dof"], {"light": light}, reference) == light).all()
    assert (judging.trivial(EFFECTS["ao"], {}, reference[:1]) == 1).all()
    assert (judging.trivial(EFFECTS["gi"], {}, reference) == 0).all()


def test_under_an_environment_it_is_what_falls_unblocked() -> None:
    """Of do the map's irradiance, of ibl its mean on matte surfaces, of full the ibl beside it."""
    grid = directions(32, 64)
    # 1 + y from above and 1 + x / 2 from the right: A(N, 1) of ω_i is 2 N_i / 3
    light = np.stack([1 + grid[1], 1 + grid[0] / 2, np.ones_like(grid[0])])
    surroundings = Surroundings(Environment("", light), degrees=90.0)
    normals = np.random.default_rng(0).normal(size=(3, 5, 8)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=0)
    normals[:, 0] = 0
    reference = np.zeros_like(normals)
    found = judging.trivial(EFFECTS["do"], {"normal_world": normals}, reference, surroundings)
    x, y, z = normals
    # turned counter-clockwise as seen from above, what was at +x is at -z
    expected = np.stack([1 + 2 / 3 * y, 1 - z / 3, np.ones_like(x)])
    assert found[:, 1:] == pytest.approx(expected[:, 1:], rel=0.01)
    assert found[:, 0] == pytest.approx(1, abs=1e-3)  # the mean where nothing faces anywhere
    matte = {"diffuse": np.full_like(reference, 0.3), "reference_ibl": normals}
    assert judging.trivial(EFFECTS["ibl"], matte, reference, surroundings) == pytest.approx(
        0.3, abs=1e-3
    )
    assert (judging.trivial(EFFECTS["full"], matte, reference, surroundings) == normals).all()
    with pytest.raises(DataError, match="'ibl' depends"):
        judging.trivial(EFFECTS["ibl"], matte, reference)


def test_occlusion_shows_something_where_it_varies() -> None:
    reference = np.float32([[[0, 0, 1, 1]]])
    assert judging.contrast(EFFECTS["ao"], reference, np.ones_like(reference)) == 0.5
    assert judging.contrast(EFFECTS["ao"], np.ones_like(reference), np.ones_like(reference)) == 0


@pytest.mark.parametrize("factor", [1e-20, 1e-3, 1e5, 1e20])
def test_light_is_judged_alike_at_any_exposure(factor: float) -> None:
    rng = np.random.default_rng(0)
    effect = EFFECTS["dof"]
    reference, blank = rng.random((2, 3, 32, 32), np.float32)
    once = judging.contrast(effect, reference, blank)
    brighter = [(image * np.float32(factor)).astype(np.float32) for image in (reference, blank)]
    assert judging.contrast(effect, *brighter) == pytest.approx(once, rel=1e-4)
    apart = judging.relative(brighter[0], brighter[1])
    assert apart == pytest.approx(judging.relative(reference, blank), rel=1e-4)
    white = np.percentile(reference, 99)
    by_hand = (np.clip(image / white, 0, 1) for image in (blank, reference))
    assert once == pytest.approx(metrics.dssim(*by_hand), rel=1e-4)


def test_a_relative_error_counts_what_is_brighter_than_white() -> None:
    reference = np.ones((3, 10, 10), np.float32)
    image = reference.copy()
    image[:, 0, 0] = 3
    assert judging.relative(reference, image) == pytest.approx(2 / 4.01 / 100, rel=1e-6)


def test_what_is_compared_is_finite_and_in_range() -> None:
    reference = np.full((3, 8, 8), 1e-29, np.float32)
    firefly = np.full((3, 8, 8), 3e38, np.float32)
    for image in judging.exposed(EFFECTS["dof"], reference, reference, firefly, -firefly):
        assert np.isfinite(image).all()
        assert image.min() >= 0
        assert image.max() <= 1
