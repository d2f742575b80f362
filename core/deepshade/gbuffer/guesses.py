"""Which lens would make depth and normals go together, for errors that have to name one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.gbuffer.axes import AS_STORED
from deepshade.gbuffer.channels import Choice
from deepshade.gbuffer.pairs import Pairs, misfits, parallel, slopes_between
from deepshade.gbuffer.plan import Plan

Array = NDArray[np.floating[Any]]

_ANGLES = np.geomspace(8, 130, 24)
_APART = 0.05  # by how much the better of two lenses has to fit better
_FITS = 0.35  # misfit of lenses that fit
_SAME = 0.9  # cosine of normals on one surface
_PINHOLE: dict[str, Any] = {"projection": "perspective", "across": 0.0}


def suggestion(
    plan: Plan, read: Callable[[Mapping[str, Choice]], Mapping[str, NDArray[np.float32]]]
) -> str:
    """The options that ask for a lens, where a plan lacks one and could do with it; else "".

    `read` gives quantities of the plan.
    """
    if plan.camera is not None or not {"depth", "normal"} <= plan.choices.keys():
        return ""
    (part, *_) = plan.parts(plan.choices["depth"])
    if not all(plan.complete(plan.choices[name], part.data_window) for name in ("depth", "normal")):
        return ""
    arrays = read({name: plan.choices[name] for name in ("depth", "normal")})
    windows = part.data_window, part.display_window
    camera = Camera.framed(part.attributes, *windows, None, fov=50)
    return fitting_lens(arrays["normal"], arrays["depth"], camera)[0]


def fitting_lens(
    normal: NDArray[np.float32], planar: NDArray[np.float32], camera: Camera
) -> tuple[str, float]:
    """The options that ask for the lens that fits camera-space normals (3, H, W) and planar depth
    (1, H, W) best, and by how much they misfit then; "" and 1 where none fits.

    `camera` has the picture's windows; its lens doesn't matter. Parallel rays see a depth that
    changes by -n.x / n.z of what lies between two pixels, which tells the frame's width.
    """
    found = [("", 1.0)]
    # samples that lie anywhere in their pixels are off by less of what lies between distant ones
    for apart in (1, 4, 8):
        if min(planar.shape[1:]) >= 4 * apart:
            pairs = Pairs.of(planar.shape[1:], apart=apart)
            found.append(_fitting(pairs.cut(normal), pairs.cut(planar)[0], camera, pairs))
    return min(found, key=lambda each: each[1])


def _fitting(normals: Array, depth: Array, camera: Camera, pairs: Pairs) -> tuple[str, float]:
    good = (np.isfinite(depth) & (depth > 0) & (np.abs(normals).sum(0) > 0)).all(0)
    good &= (normals[:, 0] * normals[:, 1]).sum(0) > _SAME
    if np.count_nonzero(good) < 32:
        return "", 1.0
    normals, depth = normals[:, :, good], depth[:, good]
    at = pairs.columns[:, good], pairs.rows[:, good]

    def perspective(angle: float) -> float:
        return _misfit(normals, depth, replace(camera, **_PINHOLE, fov=float(angle)), *at)

    off = [perspective(angle) for angle in _ANGLES]
    best = int(np.argmin(off))
    low, high = _ANGLES[max(0, best - 1)], _ANGLES[min(len(_ANGLES) - 1, best + 1)]
    near = np.linspace(float(low), float(high), 41)
    least, angle = min((perspective(angle), angle) for angle in near)
    width, flat = _width(normals, depth, *at, camera), 1.0
    if width > 0:
        parallel_rays = replace(camera, projection="orthographic", across=width)
        flat = _misfit(normals, depth, parallel_rays, *at)
    if min(least, flat) > _FITS or abs(least - flat) < _APART:
        return "", 1.0
    if flat < least:
        return f"--projection orthographic --ortho-width {width:.3g}", flat
    return f"--fov {angle:.3g}", least


def _misfit(normals: Array, depth: Array, camera: Camera, columns: Any, rows: Any) -> float:
    points = camera.points_at(columns, rows, depth)
    if camera.projection == "orthographic":
        depth, rays = parallel(points, 100 * (camera.across + float(depth.max())))
    else:
        rays = camera.rays_at(columns, rows)
    with np.errstate(all="ignore"):
        ((off,), (facing,)) = misfits(normals, rays, slopes_between(depth, rays), (AS_STORED,))
    return float(off) if facing > 0.9 else 1.0


def _width(normals: Array, depth: Array, columns: Any, rows: Any, camera: Camera) -> float:
    """The width of an orthographic frame, by the weighted median of what each pair says."""
    mean = normals.sum(1)
    with np.errstate(all="ignore"):
        across = (columns[1] - columns[0]) * mean[0] / mean[2]
        down = -(rows[1] - rows[0]) * mean[1] / mean[2] / camera.pixel_aspect
        slope = across + down
        pixel = (depth[1] - depth[0]) / slope
    usable = np.isfinite(pixel) & (np.abs(slope) > 0.05)
    if np.count_nonzero(usable) < 16:
        return 0.0
    pixel, weight = pixel[usable], np.abs(slope[usable])
    order = np.argsort(pixel)
    total = np.cumsum(weight[order])
    return float(pixel[order][np.searchsorted(total, total[-1] / 2)]) * camera.width
