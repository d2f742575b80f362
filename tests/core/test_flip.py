"""FLIP against the formulas of its paper, written out a second time.

Andersson, Nilsson, Akenine-Möller, Oskarsson, Åström, Fairchild: "FLIP: A Difference Evaluator for
Alternating Images", 2020; the sections below are that paper's.
"""

import numpy as np
import pytest
from scipy.ndimage import correlate

from deepshade import metrics

# linear sRGB to XYZ, and the white that follows from it
TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
WHITE = TO_XYZ.sum(1)[:, None, None]
# contrast sensitivity of Y, Cx, Cz (table 1): a1, b1, a2, b2
SENSITIVITY = ((1, 0.0047, 0, 1e-5), (1, 0.0053, 0, 1e-5), (34.1, 0.04, 13.5, 0.025))
QC, PC, PT, QF, FEATURE_WIDTH = 0.7, 0.4, 0.95, 0.5, 0.082


def mix(matrix, image):
    return np.einsum("ij,jhw->ihw", matrix, image)


def opponent(rgb):
    """YCxCz."""
    x, y, z = mix(TO_XYZ, rgb) / WHITE
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def from_opponent(ycc):
    y = (ycc[0] + 16) / 116
    return mix(np.linalg.inv(TO_XYZ), np.stack([y + ycc[1] / 500, y, y - ycc[2] / 200]) * WHITE)


def hunt_lab(rgb):
    """CIELab with chroma scaled by lightness."""
    t = mix(TO_XYZ, rgb) / WHITE
    edge = 6 / 29
    x, y, z = np.where(t > edge**3, np.cbrt(t), t / (3 * edge**2) + 4 / 29)
    lightness = 116 * y - 16
    return np.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)])


def hyab(a, b):
    return np.abs(a[0] - b[0]) + np.hypot(a[1] - b[1], a[2] - b[2])


def filtered(plane, kernel):
    return correlate(plane, kernel, mode="nearest")


def seen(rgb, ppd):
    """What the eye resolves, as Hunt-adjusted Lab (section 4.1)."""
    radius = int(np.ceil(3 * np.sqrt(0.04 / (2 * np.pi**2)) * ppd))
    steps = np.arange(-radius, radius + 1) / ppd
    squares = steps**2 + steps[:, None] ** 2
    planes = []
    for plane, (a1, b1, a2, b2) in zip(opponent(rgb), SENSITIVITY, strict=True):
        kernel = sum(
            a * np.sqrt(np.pi / b) * np.exp(-(np.pi**2) * squares / b)
            for a, b in ((a1, b1), (a2, b2))
        )
        planes.append(filtered(plane, kernel / kernel.sum()))
    return hunt_lab(np.clip(from_opponent(np.stack(planes)), 0, 1))


def features(rgb, ppd):
    """Strengths of edges and of points (section 4.2)."""
    grey = (opponent(rgb)[0] + 16) / 116
    sigma = 0.5 * FEATURE_WIDTH * ppd
    radius = int(np.ceil(3 * sigma))
    x = np.arange(-radius, radius + 1) + np.zeros((2 * radius + 1, 1))
    bell = np.exp(-(x**2 + x.T**2) / (2 * sigma**2))
    strengths = []
    for kernel in (-x * bell, (x**2 / sigma**2 - 1) * bell):
        positive, negative = kernel[kernel > 0].sum(), -kernel[kernel < 0].sum()
        kernel = np.where(kernel > 0, kernel / positive, kernel / negative)
        strengths.append(np.hypot(filtered(grey, kernel), filtered(grey, kernel.T)))
    return strengths


def flip(image, reference, ppd):
    green, blue = (hunt_lab(np.eye(3)[n][:, None, None]) for n in (1, 2))
    most = hyab(green, blue) ** QC
    error = hyab(seen(reference, ppd), seen(image, ppd)) ** QC
    knee = PC * most
    colour = np.where(
        error < knee, PT / knee * error, PT + (error - knee) / (most - knee) * (1 - PT)
    )
    pairs = zip(features(reference, ppd), features(image, ppd), strict=True)
    feature = (np.maximum(*(np.abs(a - b) for a, b in pairs)) / np.sqrt(2)) ** QF
    return float((colour ** (1 - feature)).mean())


def pictures(kind):
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0:44, 0:60] / 50
    reference = np.stack([0.5 + 0.4 * np.sin(9 * x), y, 0.3 + 0.2 * np.cos(7 * x * y)])
    if kind == "noise":
        return np.clip(reference + rng.normal(0, 0.1, reference.shape), 0, 1), reference
    if kind == "shifted edge":
        return np.where(x > 0.62, reference, 0.1), np.where(x > 0.58, reference, 0.1)
    if kind == "colours":
        return reference[::-1], reference
    grey = np.broadcast_to(reference.mean(0), reference.shape)
    return np.clip(grey + 0.3 * (rng.random(grey.shape[1:]) > 0.95), 0, 1), grey


@pytest.mark.parametrize("kind", ["noise", "shifted edge", "colours", "specks in grey"])
@pytest.mark.parametrize("ppd", [67.0, 30.0])
def test_flip_is_the_papers(kind, ppd):
    image, reference = pictures(kind)
    expected = flip(image, reference, ppd)
    assert 0.01 < expected < 0.9
    found = metrics.flip(image, reference, pixels_per_degree=ppd)
    assert found == pytest.approx(expected, abs=2e-5)
