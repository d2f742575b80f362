"""The rules' claims against brute force: every pair of pixels of random pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.gbuffer import GBuffer
from deepshade.relevance import Sight, no_occluder, sight_of_camera, sight_of_positions


def view(camera, height, width, seed, *, half=False):
    """A G-buffer of random depths over three decades, a fifth of it background."""
    rng = np.random.default_rng(seed)
    depth = 10.0 ** rng.uniform(0, 3, (height, width))
    background = rng.random((height, width)) < 0.2
    position = camera.rays(width, height) * depth
    if half:
        position = position.astype(np.float16)
    position = np.where(background, 0, position).astype(np.float32)
    return GBuffer({"position": position}, background, camera)


@st.composite
def cameras(draw):
    width, height = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    frame = width + draw(st.integers(0, 20)), height + draw(st.integers(0, 20))
    camera = Camera(
        draw(st.floats(5, 150)),
        *frame,
        x0=draw(st.integers(-5, 5)),
        y0=draw(st.integers(-5, 5)),
        center=(draw(st.floats(-1, 1)), draw(st.floats(-1, 1))),
        pixel_aspect=draw(st.sampled_from([1.0, 0.5, 2.0])),
    )
    return camera, height, width


@settings(max_examples=150, deadline=None)
@given(
    cameras(), st.integers(0, 2**31), st.floats(0.001, 30), st.booleans(), st.sampled_from([0, 1])
)
def test_no_pixel_lies_within_the_radius_of_a_known_one(made, seed, radius, blind, half):
    camera, height, width = made
    gbuffer = view(camera, height, width, seed, half=bool(half))
    if blind:  # the camera isn't known, only the positions
        gbuffer.camera = None
    known = no_occluder(gbuffer, radius)
    assume(known is not None)
    assert known.value == 1.0
    assert not (known.pixels & gbuffer.background).any()
    # where the points are, before they were rounded to the file's 16 bits
    exact = camera.rays(width, height).astype(np.float64)
    z = gbuffer.attributes["position"][2]
    points = (exact * -z).reshape(3, -1).T[~gbuffer.background.ravel()]
    chosen = known.pixels.ravel()[~gbuffer.background.ravel()]
    distance = np.linalg.norm(points[chosen, None] - points[None], axis=2)
    distance[distance == 0] = np.inf  # itself
    assert distance.min(initial=np.inf) > radius


def test_it_finds_nearly_all_that_it_could():
    """On the axis the bound is sharp but for the picture's longest ray."""
    camera = Camera(40.0, 32, 24)
    gbuffer = view(camera, 24, 32, 1)
    radius = 1.0
    points = gbuffer.attributes["position"].reshape(3, -1).T.astype(np.float64)
    alone = np.array([np.sort(np.linalg.norm(points - p, axis=1))[1] > radius for p in points])
    alone = alone.reshape(24, 32) & ~gbuffer.background
    known = no_occluder(gbuffer, radius)
    assert known is not None
    assert not (known.pixels & ~alone).any()
    sight = sight_of_camera(camera, 24, 32)
    assert (known.pixels == (gbuffer.attributes["position"][2] < -sight.depth_beyond(radius))).all()
    assert sight.longest < 1.2
    assert known.pixels.sum() > 0.5 * alone.sum()


def test_two_neighbours_on_the_axis_are_as_near_as_the_bound_says():
    sight = Sight(pitch=0.01, longest=1.0)
    depth = sight.depth_beyond(0.5)
    assert depth == pytest.approx(50, rel=2e-3)
    a, b = np.array([0, 0, -depth]), depth * np.array([0.01, 0, -1])
    assert np.linalg.norm(a - b) == pytest.approx(0.5, rel=2e-3)


@pytest.mark.parametrize("half", [False, True])
def test_positions_tell_the_camera(half):
    camera = Camera(70.0, 60, 40, x0=3, y0=-2, center=(0.2, -0.1), pixel_aspect=2.0)
    found = sight_of_positions(view(camera, 40, 50, 3, half=half).attributes["position"])
    stated = sight_of_camera(camera, 40, 50)
    assert found is not None
    assert found.pitch == pytest.approx(stated.pitch, rel=2e-3)
    assert found.longest == pytest.approx(stated.longest, rel=2e-3)


def test_what_is_unknown_or_contradictory_is_not_claimed():
    camera = Camera(40.0, 32, 24)
    gbuffer = view(camera, 24, 32, 1)
    assert no_occluder(gbuffer, 0.01) is not None
    gbuffer.camera = Camera(120.0, 32, 24)  # a wrong field of view beside good positions
    assert no_occluder(gbuffer, 0.01) is None
    gbuffer.camera = None
    position = gbuffer.attributes["position"]
    position[:2] = np.where(gbuffer.background, 0, np.mgrid[0:24, 0:32])  # orthographic
    assert no_occluder(gbuffer, 0.01) is None
    one = GBuffer({"position": -np.ones((3, 1, 1), np.float32)}, np.zeros((1, 1), bool))
    assert no_occluder(one, 1e-6) is None
    assert no_occluder(GBuffer({}, np.zeros((2, 2), bool)), 1e-6) is None


def test_a_huge_or_tiny_radius():
    gbuffer = view(Camera(40.0, 32, 24), 24, 32, 1)
    assert no_occluder(gbuffer, 1e30) is None
    known = no_occluder(gbuffer, 1e-30)
    assert known is not None
    assert (known.pixels == ~gbuffer.background).all()


def test_which_effects_have_a_rule():
    assert EFFECTS["ao"].open_rule is no_occluder
    assert EFFECTS["ibl"].open_rule is None
