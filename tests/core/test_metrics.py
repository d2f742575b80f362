"""Metrics against brute force, against scikit-image, and against values known beforehand."""

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from deepshade import metrics


def brute_force_ssim(x, y, size=8, c1=1e-4, c2=1e-3):
    """The definition, window by window, in Python floats."""
    height, width = x.shape
    values = []
    for top in range(height - size + 1):
        for left in range(width - size + 1):
            a = [float(v) for v in x[top : top + size, left : left + size].ravel()]
            b = [float(v) for v in y[top : top + size, left : left + size].ravel()]
            n = len(a)
            ma, mb = math.fsum(a) / n, math.fsum(b) / n
            va = math.fsum((v - ma) ** 2 for v in a) / n
            vb = math.fsum((v - mb) ** 2 for v in b) / n
            cov = math.fsum((u - ma) * (v - mb) for u, v in zip(a, b, strict=True)) / n
            values.append(
                (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
            )
    return math.fsum(values) / len(values)


def pair(height, width, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.random((height, width))
    return x, np.clip(x + rng.normal(0, 0.2, x.shape), 0, 1)


@pytest.mark.parametrize("shape", [(8, 8), (9, 8), (21, 34), (40, 13)])
def test_ssim_is_the_definition(shape):
    x, y = pair(*shape)
    assert metrics.ssim(x, y) == pytest.approx(brute_force_ssim(x, y), abs=1e-12)


@pytest.mark.parametrize("offset", [1e3, 1e6])
def test_large_offsets_do_not_cancel(offset):
    x, y = pair(16, 16)
    x, y = x + offset, y + offset
    assert metrics.ssim(x, y) == pytest.approx(brute_force_ssim(x, y), abs=1e-9)


@pytest.mark.parametrize("window", [3, 7, 11])
def test_ssim_agrees_with_scikit_image(window):
    x, y = pair(50, 61, seed=window)
    expected, full = structural_similarity(
        x,
        y,
        win_size=window,
        data_range=1.0,
        K1=math.sqrt(1e-4),
        K2=math.sqrt(1e-3),
        use_sample_covariance=False,
        full=True,
    )
    border = window // 2
    ours = metrics.ssim_map(x, y, window=window)
    np.testing.assert_allclose(ours, full[border:-border, border:-border], atol=1e-10)
    assert metrics.ssim(x, y, window=window) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("offset", [-3, 100])
def test_ssim_agrees_with_scikit_image_far_from_0(offset):
    x, y = (plane + offset for plane in pair(40, 50))
    constants = {"K1": math.sqrt(1e-4), "K2": math.sqrt(1e-3), "use_sample_covariance": False}
    expected = structural_similarity(x, y, win_size=7, data_range=1.0, **constants)
    assert metrics.ssim(x, y, window=7) == pytest.approx(expected, abs=1e-9)


def test_ssim_of_constants_by_hand():
    x, y = np.full((12, 12), 0.25), np.full((12, 12), 0.75)
    # no variance: only the means' term is left
    assert metrics.ssim(x, y) == pytest.approx((2 * 0.1875 + 1e-4) / (0.625 + 1e-4), abs=1e-14)
    assert metrics.ssim(x, x) == 1.0
    assert metrics.dssim(x, x) == 0.0


def test_channels_average():
    x, y = pair(20, 20)
    both = metrics.ssim(np.stack([x, x]), np.stack([y, x]))
    assert both == pytest.approx((metrics.ssim(x, y) + 1) / 2)
    assert metrics.dssim(x, y) == pytest.approx((1 - metrics.ssim(x, y)) / 2)


@pytest.mark.parametrize("shape", [(1, 1), (3, 20), (20, 3)])
def test_images_smaller_than_the_window(shape):
    x, y = pair(*shape)
    assert metrics.ssim(x, x) == pytest.approx(1)
    assert -1 <= metrics.ssim(x, y) <= 1


def test_strips_change_nothing(monkeypatch):
    x, y = pair(70, 30)
    whole = metrics.ssim_map(x, y)
    monkeypatch.setattr(metrics, "_STRIP", 5)
    np.testing.assert_array_equal(metrics.ssim_map(x, y), whole)


def test_psnr_and_mae_by_hand():
    x = np.zeros((4, 4))
    y = np.full((4, 4), 0.1)
    assert metrics.psnr(x, y) == pytest.approx(20)
    assert metrics.psnr(x, x) == math.inf
    assert metrics.mae(x, y) == pytest.approx(0.1)


def test_flip_is_zero_for_equal_and_one_for_black_against_white():
    black, white = np.zeros((24, 24)), np.ones((24, 24))
    assert metrics.flip(white, white) == 0
    assert metrics.flip(black, white) > 0.9
    grey = np.full((24, 24), 0.5)
    assert metrics.flip(grey, white) == pytest.approx(
        metrics.flip(np.stack([grey] * 3), np.stack([white] * 3))
    )


@pytest.mark.parametrize(
    ("x", "y"),
    [
        (np.zeros((4, 4)), np.zeros((4, 5))),
        (np.zeros(4), np.zeros(4)),
        (np.zeros((0, 4)), np.zeros((0, 4))),
        (np.full((4, 4), np.nan), np.zeros((4, 4))),
    ],
)
def test_refuses_what_is_no_pair_of_images(x, y):
    with pytest.raises(ValueError, match=r"differ|image|finite"):
        metrics.ssim(x, y)


def test_smape_by_hand():
    x, y = np.array([[3.0, 0.0, 1e5]]), np.array([[1.0, 0.0, 1e5]])
    assert metrics.smape(x, y) == pytest.approx(2 / 4.01 / 3)
    assert metrics.smape(x, x) == 0
    assert metrics.smape(x, y) == metrics.smape(y, x)
    assert metrics.smape(1e6 + np.zeros((2, 2)), np.zeros((2, 2))) == pytest.approx(
        1
    )  # no clipping


def test_exposure_makes_the_99th_percentile_1():
    light = np.random.default_rng(0).lognormal(2, 2, (3, 40, 50))
    factor = metrics.exposure(light)
    assert np.percentile(factor * light, 99) == pytest.approx(1)
    assert metrics.exposure(1e5 * light) == pytest.approx(1e-5 * factor)
    mostly_black = np.zeros((20, 20))
    assert metrics.exposure(mostly_black) == 1
    mostly_black[3, 4] = 5
    assert metrics.exposure(mostly_black) == pytest.approx(0.2)
    assert math.isfinite(metrics.exposure(np.full((4, 4), 5e-324)))
    with pytest.raises(ValueError, match="finite"):
        metrics.exposure(np.full((4, 4), np.inf))
