"""Filtered G-buffers against the point samples that they were made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.core.test_checks import NEEDS, N, P

from deepshade.errors import ContradictionError
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.conventions import Conventions
from deepshade.gbuffer.mixtures import unmix

CASES = Path(__file__).parents[1] / "cases"
H, W, FINE = 48, 64, 6  # samples each way of a pixel


def sphere_before_nothing(scale: int):
    """(N, P) of a sphere in front of the camera, with a field of view of 53°, `scale` times as
    large; 0 beside it."""
    height, width = H * scale, W * scale
    y, x = np.mgrid[0:height, 0:width] + 0.5
    rays = np.stack([x / width - 0.5, (0.5 * height - y) / width, -np.ones_like(x)])
    centre, radius = np.array([0.1, 0.0, -4.0]), 1.1
    a, b = (rays**2).sum(0), (rays * centre[:, None, None]).sum(0)
    root = b**2 - a * (centre @ centre - radius**2)
    hit = root > 0
    distance = (b - np.sqrt(np.maximum(root, 0))) / a
    position = np.where(hit, rays * distance, 0)
    normal = np.where(hit, (position - centre[:, None, None]) / radius, 0)
    return normal.astype(np.float32), position.astype(np.float32)


def filtered(array):
    """The mean over each pixel and half of its neighbours."""
    kernel = np.hanning(2 * FINE + 2)[1:-1]
    kernel /= kernel.sum()
    for axis in (1, 2):
        array = np.apply_along_axis(np.convolve, axis, array, kernel, "same")
    return array[:, FINE // 2 :: FINE, FINE // 2 :: FINE].astype(np.float32)


NORMAL, POSITION = sphere_before_nothing(1)
BLURRED = {
    name: filtered(array)
    for name, array in zip(("normal", "position"), sphere_before_nothing(FINE), strict=True)
}


def error(arrays):
    """The mean distance from the exact positions, where both show the surface."""
    both = (arrays["normal"] != 0).any(0) & (NORMAL != 0).any(0)
    return np.abs(arrays["position"] - POSITION).max(0)[both].mean()


def test_a_silhouette_is_repaired():
    arrays = {name: array.copy() for name, array in BLURRED.items()}
    notes, warning = unmix(arrays)
    assert set(notes) == {"normal", "position"}
    assert "filter" in warning
    shown = (arrays["normal"] != 0).any(0)
    assert (shown != (NORMAL != 0).any(0)).mean() < 0.01  # before: a ring two pixels wide
    assert ((BLURRED["normal"] != 0).any(0) != (NORMAL != 0).any(0)).mean() > 0.02
    length = np.sqrt((arrays["normal"] ** 2).sum(0))
    assert length[shown].min() > 0.9
    assert error(arrays) < 0.3 * error(BLURRED)


def test_depth_alone():
    stored = -BLURRED["position"][2:]
    arrays = {"depth": stored.copy()}
    _, warning = unmix(arrays)
    assert warning
    shown = arrays["depth"][0] > 0
    assert (shown != (NORMAL != 0).any(0)).mean() < 0.01
    both = shown & (NORMAL != 0).any(0)
    off, raw = (np.abs(depth[0] + POSITION[2])[both] for depth in (arrays["depth"], stored))
    assert off.mean() < 0.3 * raw.mean()
    assert off.max() < 0.5 * raw.max()


@pytest.mark.parametrize("short", [False, True])
def test_point_samples_stay(short):
    scale = np.float32(0.9) if short else np.float32(1)  # as interpolation shortens them
    arrays = {"normal": scale * NORMAL, "position": POSITION.copy()}
    assert unmix(arrays) == ({}, "")
    np.testing.assert_array_equal(arrays["normal"], scale * NORMAL)
    arrays = {"normal": N.copy(), "position": P.copy()}
    assert unmix(arrays) == ({}, "")


def test_mitsuba_s_default_filter():
    """Its box filter gives the same view, and so must the repaired one."""
    wanted = load_gbuffer(CASES / "mitsuba_aov_box1.exr", NEEDS, fov=45)
    assert not wanted.warnings
    assert "worldToCamera from world-space positions" in wanted.derived["normal"]
    mended = load_gbuffer(CASES / "mitsuba_aov_gauss16.exr", NEEDS, fov=45)
    assert "filter" in mended.warnings[0]
    assert (mended.background != wanted.background).mean() < 0.01
    trust = Conventions(checks="trust")
    raw = load_gbuffer(CASES / "mitsuba_aov_gauss16.exr", NEEDS, fov=45, conventions=trust)
    assert (raw.background != wanted.background).mean() > 0.05
    with pytest.raises(ContradictionError, match="filter"):
        load_gbuffer(
            CASES / "mitsuba_aov_gauss16.exr",
            NEEDS,
            fov=45,
            conventions=Conventions(checks="strict"),
        )
