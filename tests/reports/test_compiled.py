"""The compiled kernels against the same methods as separate array operations."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from deepshade.errors import DeepshadeError
from deepshade_report.baselines.ao import gtao, hbao
from deepshade_report.baselines.ao.horizons import open_field
from deepshade_report.method import Float, View

try:
    from deepshade_report.baselines.ao import compiled
except (ModuleNotFoundError, DeepshadeError) as error:  # no Dr.Jit or no libLLVM
    pytest.skip(f"no compiled kernels here: {error}", allow_module_level=True)

HEIGHT, WIDTH = 44, 60
PLAIN = {"power": 1.0, "intensity": 1.0, "spread": 1.0, "bias": 0.0, "blur": 0}
UNEVEN = {
    "radius": 1.3,
    "falloff": 0.4,
    "bias": 0.05,
    "intensity": 1.2,
    "power": 0.8,
    "spread": 1.6,
    "blur": 3,
    "edge": 0.1,
}


def bumps(radius: float = 0.4, scale: float = 1.0) -> View:
    """A wavy wall with a hole of background, seen off the axis; `scale` multiplies lengths."""
    fov, axis, pixels = 50.0, (20.0, 30.0), 70.0
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    depth = 3 + 0.25 * np.sin(column / 4) * np.cos(row / 5) + 0.01 * column
    x, y = (column - axis[0]) / pixels * depth, (axis[1] - row) / pixels * depth
    position = np.stack([x, y, -depth])
    down, across = (
        np.stack(v) for v in zip(*(np.gradient(plane) for plane in position), strict=True)
    )
    normal = np.cross(down, across, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    normal *= np.sign(normal[2])
    background = (column - 40) ** 2 + (row - 15) ** 2 < 60
    return View(
        "bumps",
        np.where(background, 0, normal).astype(np.float32),
        np.where(background, 0, position * scale).astype(np.float32),
        background,
        radius * scale,
        fov,
        np.ones((HEIGHT, WIDTH), np.float32),
        pixels,
        axis,
    )


def both(method: Any, fast: Any, view: View, sizes: tuple[int, int], p: Any) -> tuple[Float, Float]:
    slow = method.occlude(open_field(view), *sizes, p)
    return slow, fast(compiled.open_screen(view), *sizes, p)


@pytest.mark.parametrize("sizes", [(1, 2), (3, 5)])
@pytest.mark.parametrize("changes", [PLAIN, UNEVEN, {**UNEVEN, "thickness": 0.3, "thin": 0.7}])
def test_gtao(sizes: tuple[int, int], changes: dict[str, Any]) -> None:
    p = dataclasses.replace(gtao.Parameters(), **changes)
    slow, fast = both(gtao, compiled.gtao, bumps(), sizes, p)
    assert slow.std() > 0.01
    _alike(slow, fast)


@pytest.mark.parametrize("sizes", [(2, 2), (6, 5)])
@pytest.mark.parametrize("changes", [PLAIN, UNEVEN, {**UNEVEN, "bias": 0.5}])
def test_hbao(sizes: tuple[int, int], changes: dict[str, Any]) -> None:
    p = dataclasses.replace(hbao.Parameters(), **changes)
    slow, fast = both(hbao, compiled.hbao, bumps(), sizes, p)
    assert slow.std() > 0.01
    _alike(slow, fast)


def _alike(slow: Float, fast: Float) -> None:
    apart = np.abs(slow - fast)
    # a sample that falls between two pixels may be rounded to either
    assert (apart > 1e-4).mean() < 2e-3
    assert apart.mean() < 1e-4


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_a_scaled_scene_shades_alike(scale: float) -> None:
    for fast, p in ((compiled.gtao, gtao.Parameters()), (compiled.hbao, hbao.Parameters())):
        one = fast(compiled.open_screen(bumps()), 2, 4, p)
        _alike(one, fast(compiled.open_screen(bumps(scale=scale)), 2, 4, p))


def test_what_is_not_finite_is_open_and_spreads_nowhere() -> None:
    view = bumps()
    view.position[:, 5, 5] = np.nan
    view.normal[:, 30, 40] = np.inf
    view.normal[:, 31, 40] = 0
    view.position[2, 20, 8] = 1  # behind the eye
    holes = [(5, 5), (30, 40), (31, 40), (20, 8)]
    for fast, p in ((compiled.gtao, gtao.Parameters()), (compiled.hbao, hbao.Parameters())):
        image = fast(compiled.open_screen(view), 2, 4, p)
        assert np.isfinite(image).all()
        assert all(image[place] == 1 for place in holes)
        assert (image[view.background] == 1).all()
        assert (image >= 0).all()
        assert (image <= 1).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1)])
def test_tiny_pictures(shape: tuple[int, int]) -> None:
    view = bumps()
    rows, columns = slice(0, shape[0]), slice(0, shape[1])
    cut = dataclasses.replace(
        view,
        normal=view.normal[:, rows, columns],
        position=view.position[:, rows, columns],
        background=view.background[rows, columns],
        reference=view.reference[rows, columns],
    )
    for method, fast in ((gtao, compiled.gtao), (hbao, compiled.hbao)):
        slow, quick = both(method, fast, cut, (2, 3), method.Parameters())
        assert quick.shape == shape
        assert np.allclose(slow, quick, atol=1e-4)
