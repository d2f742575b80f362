"""Views of planes, cast by hand, for tests with closed forms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade_report.view import View

Plane = tuple[Sequence[float], float]  # normal (not unit) n and c: points with n · p = c


def cast(planes: Sequence[Plane], *, size: int, fov: float, radius: float) -> View:
    """A square view of the nearest of some infinite planes, background where there is none."""
    rays = Camera(fov, size, size).rays().astype(np.float64)
    nearest = np.full((size, size), np.inf)
    normal = np.zeros((3, size, size))
    for direction, c in planes:
        n = np.asarray(direction, float) / math.hypot(*direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = c / math.hypot(*direction) / np.tensordot(n, rays, 1)
        hit = (t > 0) & (t < nearest)
        nearest[hit] = t[hit]
        facing = np.tensordot(n, rays, 1) < 0
        normal = np.where(hit, np.where(facing, 1, -1) * n[:, None, None], normal)
    background = ~np.isfinite(nearest)
    position = np.where(background, 0, rays * np.where(background, 0, nearest))
    return made(normal, position, background, radius, fov)


def groove(left: float, right: float, *, size: int = 256, fov: float = 8.0) -> View:
    """A crease along y in the middle, 1 away, its two walls rising by these angles in degrees.

    The radius spans about the picture's width; a narrow view is nearly that of parallel rays.
    """
    walls = [((math.tan(math.radians(left)), 0.0, 1.0), -1.0)]
    walls.append(((-math.tan(math.radians(right)), 0.0, 1.0), -1.0))
    return cast(walls, size=size, fov=fov, radius=2 * math.tan(math.radians(fov / 2)))


def rubble(size: int = 64, *, radius: float = 0.5, scale: float = 1.0) -> View:
    """Random steps before a plane, with some background; `scale` multiplies all lengths."""
    rng = np.random.default_rng(7)
    coarse = rng.uniform(2, 3, (size // 8, size // 8))
    depth = np.kron(coarse, np.ones((8, 8))) + rng.uniform(0, 0.02, (size, size))
    background = np.kron(rng.random((size // 8, size // 8)) < 0.2, np.ones((8, 8))) > 0
    position = Camera(50.0, size, size).rays() * depth * scale
    normal = rng.normal(size=(3, size, size)) * 0.3
    normal[2] = 1
    return made(normal, position, background, radius * scale, 50.0)


def made(
    normal: np.ndarray, position: np.ndarray, background: np.ndarray, radius: float, fov: float
) -> View:
    """A view without a reference."""
    length = np.linalg.norm(normal, axis=0)
    normal = np.where(background, 0, normal / np.where(length > 0, length, 1))
    position = np.where(background, 0, position)
    return View(
        "walls",
        EFFECTS["ao"],
        {"normal": normal.astype(np.float32), "position": position.astype(np.float32)},
        background,
        np.ones((1, *background.shape), np.float32),
        radius,
        Camera(fov, background.shape[1], background.shape[0]),
    )


def degenerate() -> dict[str, View]:
    """Views that show nothing, or no sense."""
    one = np.array([[False]])
    up = np.array([0.0, 0.0, 1.0]).reshape(3, 1, 1)
    whole = rubble(16)
    normal, position = whole.attributes["normal"], whole.attributes["position"]
    nan = position.copy()
    nan[:, ::2] = np.nan
    return {
        "one pixel": made(up, -up, one, 1.0, 50.0),
        "one pixel of background": made(up, -up, ~one, 1.0, 50.0),
        "all background": made(normal, position, np.ones((16, 16), bool), 1.0, 50.0),
        "zero normals": made(np.zeros((3, 16, 16)), position, whole.background, 1.0, 50.0),
        "normals that face away": made(-normal, position, whole.background, 1.0, 50.0),
        "all at one place": made(normal, np.full((3, 16, 16), -1.0), whole.background, 1.0, 50.0),
        "positions that aren't finite": made(normal, nan, whole.background, 1.0, 50.0),
        "behind the eye": made(normal, -position, whole.background, 1.0, 50.0),
        "at the eye": made(normal, position * 1e-20, whole.background, 1.0, 50.0),
        "a radius below a pixel": made(normal, position, whole.background, 1e-6, 50.0),
    }
