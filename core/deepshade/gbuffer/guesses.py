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
    return fitting_lens(
        arrays["normal"], arrays["depth"], Camera.framed(part.attributes, *windows, None, fov=50)
    )


def fitting_lens(normal: NDArray[np.float32], planar: NDArray[np.float32], camera: Camera) -> str:
    """The options that ask for the lens that fits camera-space normals (3, H, W) and planar depth
    (1, H, W) best; "" where none fits.

    `camera` has the picture's windows; its lens doesn't matter. Parallel rays see a depth that
    changes by -n.x / n.z of what lies between two pixels, which tells the frame's width.
    """
    # pixels apart: samples that lie anywhere in their pixels are off by less of it
    pairs = Pairs.of(planar.shape[1:], apart=8 if min(planar.shape[1:]) >= 32 else 1)
    normals, depth = pairs.cut(normal), pairs.cut(planar)[0]
    good = (np.isfinite(depth) & (depth > 0) & (np.abs(normals).sum(0) > 0)).all(0)
    good &= (normals[:, 0] * normals[:, 1]).sum(0) > 0.9  # one surface
    if np.count_nonzero(good) < 32:
        return ""
    normals, depth = normals[:, :, good], depth[:, good]
    columns, rows = pairs.columns[:, good], pairs.rows[:, good]
    widths = _widths(normals, depth, columns, rows, camera)
    lenses = [(f"--fov {angle:.3g}", replace(camera, fov=float(angle))) for angle in _ANGLES]
    if widths > 0:
        wide = replace(camera, projection="orthographic", across=widths)
        option = f"--projection orthographic --ortho-width {widths:.3g}"
        lenses.append((option, wide))
    off = [_misfit(normals, depth, lens, columns, rows) for _, lens in lenses]
    best = int(np.argmin(off))
    if lenses[best][1].projection == "perspective":
        near = np.linspace(*_ANGLES[[max(0, best - 1), min(len(_ANGLES) - 1, best + 1)]], 41)
        fine = [
            (_misfit(normals, depth, replace(camera, fov=float(a)), columns, rows), a) for a in near
        ]
        other = off[-1] if widths > 0 else 1.0
        (least, angle) = min(fine)
        return f"--fov {angle:.3g}" if least < min(_FITS, other - _APART) else ""
    return lenses[best][0] if off[best] < min(_FITS, min(off[:-1]) - _APART) else ""


def _misfit(normals: Array, depth: Array, camera: Camera, columns: Any, rows: Any) -> float:
    points = camera.points_at(columns, rows, depth)
    if camera.projection == "orthographic":
        depth, rays = parallel(points, 100 * (camera.across + float(depth.max())))
    else:
        rays = camera.rays_at(columns, rows)
    with np.errstate(all="ignore"):
        ((off,), (facing,)) = misfits(normals, rays, slopes_between(depth, rays), (AS_STORED,))
    return float(off) if facing > 0.9 else 1.0


def _widths(normals: Array, depth: Array, columns: Any, rows: Any, camera: Camera) -> float:
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
