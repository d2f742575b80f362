"""Positions of few bits against the exact ones that they were made from."""

from __future__ import annotations

import numpy as np
import pytest
from tests.core.test_checks import CAMERA, NEEDS, H, N, P, W, encode

from deepshade.camera import Camera
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.conventions import Conventions
from deepshade.gbuffer.geometry import normals_from_positions
from deepshade.gbuffer.repair import lattice, repair, steps_of

RADIUS = 0.3
VALID = np.ones((H, W), np.bool_)


def stored(step: float, mode: str, offset: tuple[float, ...] = (3.1, -7.7, 12.3)) -> np.ndarray:
    """P in steps at an offset, as the paper's authors have them."""
    at = (P.astype(np.float64) + np.reshape(offset, (3, 1, 1))) / step
    whole = np.round(at) if mode == "rounded" else np.floor(at)
    return (whole * step - np.reshape(offset, (3, 1, 1))).astype(np.float32)


def off(positions: np.ndarray) -> float:
    """The mean distance along the ray from the exact position."""
    return float(np.abs(positions - P).max(0).mean())


def bent(positions: np.ndarray) -> float:
    """How far the surface's own normals are from the exact ones: the mean of 1 - cos."""
    return float(1 - (normals_from_positions(positions, VALID) * N).sum(0).mean())


@pytest.mark.parametrize("mode", ["rounded", "cut off"])
@pytest.mark.parametrize("share", [60, 30, 15])
def test_steps_are_smoothed(share, mode):
    step = RADIUS / share
    coarse = stored(step, mode)
    for camera in (CAMERA, None):  # or as the positions themselves say
        arrays = {"position": coarse.copy(), "normal": N}
        notes = repair(arrays, VALID, camera, None, RADIUS)
        assert f"{step:.2g}" in notes["position"]
        # without a camera what every position is off by alike can't be known
        assert off(arrays["position"]) < (0.1 if camera else 1) * step
        assert bent(arrays["position"]) < 0.25 * bent(coarse)


def test_without_normals():
    coarse = stored(0.02, "rounded")
    arrays = {"position": coarse.copy()}
    repair(arrays, VALID, CAMERA, None, RADIUS)
    assert off(arrays["position"]) < 0.4 * off(coarse)


@pytest.mark.parametrize("cut", [False, True])
def test_16_bits_far_from_the_world_s_origin(cut):
    view = Camera.look_at((40, -55, 61), (0, 1, 0), (0, 1, 0), 50, W, H)
    inverse = np.linalg.inv(view.matrix)
    placed = np.tensordot(inverse[:3, :3], P.astype(np.float64), 1) + inverse[:3, 3, None, None]
    half = placed.astype(np.float16)
    if cut:
        half = np.where(np.abs(half) > np.abs(placed), np.nextafter(half, np.float16(0)), half)
    header = view.to_header() | {"deepshade:radius": RADIUS}
    body = encode(header, normal=N, position_world=half, half=("position_world",))
    raw = load_gbuffer(body, NEEDS, conventions=Conventions(checks="trust"))
    mended = load_gbuffer(body, NEEDS)
    assert "smoothed" in mended.derived["position_world"]
    assert off(raw.attributes["position"]) > 0.008
    assert off(mended.attributes["position"]) < 0.002
    # depth beside them is finer, and is taken
    body = encode(header, normal=N, position_world=half, Z=-P[2], half=("position_world", "Z"))
    gbuffer = load_gbuffer(body, NEEDS)
    assert "16 bits of 'position_world'" in gbuffer.derived["position"]
    assert off(gbuffer.attributes["position"]) < 0.002


def test_what_is_fine_or_lies_on_no_rays_is_left_alone():
    for positions in (P, stored(RADIUS / 1000, "rounded")):
        arrays = {"position": positions.copy(), "normal": N}
        assert repair(arrays, VALID, CAMERA, None, RADIUS) == {}
        np.testing.assert_array_equal(arrays["position"], positions)
    shaken = P + np.random.default_rng(0).uniform(-0.1, 0.1, P.shape)
    shaken = (np.round(shaken / 0.01) * 0.01).astype(np.float32)
    arrays = {"position": shaken.copy(), "normal": N}
    assert repair(arrays, VALID, CAMERA, None, RADIUS) == {}


def test_how_numbers_were_rounded():
    rays = CAMERA.rays().reshape(3, -1)
    for mode, bias in (("rounded", 0), ("cut off", -0.5)):
        some = stored(0.01, mode).reshape(3, -1)
        assert lattice(some[2]) == pytest.approx(0.01, rel=1e-3)
        assert steps_of(some, rays, np.zeros(3), (0.01,) * 3).bias == (bias,) * 3
    assert lattice(P[2].ravel()) is None
    assert lattice(P[2].astype(np.float16).astype(np.float32).ravel()) == 0


def test_coarse_depth():
    depth = -P[2:].copy()
    coarse = np.floor(depth / 0.02) * np.float32(0.02)
    arrays = {"depth": coarse.copy(), "normal": N}
    assert "smoothed" in repair(arrays, VALID, CAMERA, None, RADIUS)["depth"]
    assert np.abs(arrays["depth"] - depth).mean() < 0.7 * np.abs(coarse - depth).mean()
