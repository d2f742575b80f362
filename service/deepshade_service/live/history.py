"""Temporal reprojection: what the answer before said of a surface, carried to where it is now.

Each pixel's surface is followed back along its motion, or by the two cameras. What lies there in
the frame before counts if its depth and its normal are the surface's own; it is then held within
what the new answer says nearby, and blended exponentially. Karis, "High Quality Temporal
Supersampling" (SIGGRAPH 2014); Nehab et al., "Accelerating Real-Time Shading with Reverse
Reprojection Caching" (Graphics Hardware 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.gbuffer import GBuffer

Float = NDArray[np.float32]

DEPTH = 0.02  # by which share of its depth a surface may differ from what lay there
NORMAL = 0.9  # least cosine between the two normals
SPREAD = 1.0  # standard deviations of the neighbourhood that the old may differ by
REACH = 3  # pixels each way that are the neighbourhood
STILL = 0.5  # motions of so few pixels in most of a picture are none


@dataclass(frozen=True, slots=True)
class _Before:
    shade: Float
    depth: Float
    normal: Float | None
    camera: Camera | None


class History:
    """The answers of the frame before, by effect. One that gains nothing by it stays as it is."""

    def __init__(self) -> None:
        self._before: dict[str, _Before] = {}

    def blend(
        self, effect: str, shade: Float, gbuffer: GBuffer, motion: Float | None, *, alone: bool
    ) -> Float:
        """(C, H, W): the answer with what is kept of the one before.

        `motion` (2, H, W) is in pixels from one frame to the next, u right and v down. `alone`
        frames take nothing over (a cut, or a sharp picture); the next one may take them.
        """
        share = EFFECTS[effect].history
        position = _position(gbuffer)
        flat = gbuffer.camera is None or gbuffer.camera.projection == "perspective"
        if not share or position is None or not flat:
            return shade
        depth = -position[2]
        normal = gbuffer.attributes.get("normal")
        before = self._before.get(effect)
        if before is not None and before.shade.shape == shade.shape and not alone:
            columns, rows, expected, turned = _followed(
                position, normal, gbuffer.camera, before.camera, motion
            )
            old, weight = _fetched(before, columns, rows, expected, turned)
            weight *= share * ~gbuffer.background
            mean, deviation = _neighbourhood(shade, REACH)
            # what is new lies within too, or a picture that rests would be drawn to its mean
            low = np.minimum(mean - SPREAD * deviation, shade)
            old = np.clip(old, low, np.maximum(mean + SPREAD * deviation, shade))
            shade = shade + weight * (old - shade)
        self._before[effect] = _Before(shade, depth, normal, gbuffer.camera)
        return shade


def _position(gbuffer: GBuffer) -> Float | None:
    if "position" in gbuffer.attributes:
        return gbuffer.attributes["position"]
    if "depth" in gbuffer.attributes and gbuffer.camera is not None:
        return gbuffer.camera.position_from_depth(gbuffer.attributes["depth"][0])
    return None


def _followed(
    position: Float,
    normal: Float | None,
    camera: Camera | None,
    before: Camera | None,
    motion: Float | None,
) -> tuple[Float, Float, Float, Float | None]:
    """(columns, rows, depth there, normal there) of each pixel's surface in the frame before.

    Where both cameras are known they say it; a motion that is 0 in most of a picture whose camera
    moves is that of objects alone, and comes on top; any other is all there is.
    """
    height, width = position.shape[1:]
    rows, columns = (grid.astype(np.float32) for grid in np.indices((height, width), np.int32))
    expected, turned = -position[2], normal
    moved = False
    if (
        camera is not None
        and before is not None
        and camera.world_to_camera is not None
        and before.world_to_camera is not None
    ):
        change = before.matrix @ np.linalg.inv(camera.matrix)
        moved = not np.allclose(change, np.eye(4), atol=1e-6)
        if moved:
            there = np.tensordot(change[:3, :3].astype(np.float32), position, 1)
            there += change[:3, 3, None, None].astype(np.float32)
            expected = -there[2]
            if normal is not None:
                turned = np.tensordot(change[:3, :3].astype(np.float32), normal, 1)
            with np.errstate(divide="ignore", invalid="ignore"):
                x, y = there[0] / expected, there[1] / expected
            seen = _pixels(before, x, y)
    if motion is not None and (not moved or _objects_alone(motion)):
        start = seen if moved else (columns, rows)
        return start[0] - motion[0], start[1] - motion[1], expected, turned
    if motion is not None:
        return columns - motion[0], rows - motion[1], expected, turned
    return (*(seen if moved else (columns, rows)), expected, turned)


def _objects_alone(motion: Float) -> bool:
    return bool(np.median(np.abs(motion).max(0)) < STILL)


def _pixels(camera: Camera, x: Float, y: Float) -> tuple[Float, Float]:
    """(columns, rows) of slopes x / -z and y / -z: the inverse of `Camera.rays`."""
    scale = camera.pixels_per_unit
    columns = (x - camera.center[0]) * scale + (0.5 * camera.width - camera.x0 - 0.5)
    down = (y - camera.center[1]) * scale * camera.pixel_aspect
    return (
        columns.astype(np.float32),
        (0.5 * camera.height - camera.y0 - 0.5 - down).astype(np.float32),
    )


def _fetched(
    before: _Before, columns: Float, rows: Float, expected: Float, turned: Float | None
) -> tuple[Float, Float]:
    """(the old answer (C, H, W), how much of it counts (H, W), 0 to 1), between its pixels.

    Of the four pixels around a place those count whose depth is the one that is expected.
    """
    height, width = before.depth.shape
    inside = (columns > -0.5) & (columns < width - 0.5) & (rows > -0.5) & (rows < height - 0.5)
    columns = np.where(inside, columns, 0)
    rows = np.where(inside, rows, 0)
    left, top = np.floor(columns).astype(np.intp), np.floor(rows).astype(np.intp)
    right, down = columns - left, rows - top
    tolerance = DEPTH * np.abs(expected)
    flat, depth = before.shade.reshape(len(before.shade), -1), before.depth.ravel()
    old = np.zeros_like(before.shade)
    sum_ = np.zeros_like(expected)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at = np.clip(top + dy, 0, height - 1) * width + np.clip(left + dx, 0, width - 1)
        weight = (right if dx else 1 - right) * (down if dy else 1 - down)
        weight *= np.abs(depth.take(at) - expected) <= tolerance
        sum_ += weight
        for plane, source in zip(old, flat, strict=True):
            plane += weight * source.take(at)
    old /= np.maximum(sum_, 1e-6)
    counts = inside & (sum_ > 0.1)
    if turned is not None and before.normal is not None:
        nearest = np.clip(np.rint(rows), 0, height - 1).astype(np.intp) * width
        nearest += np.clip(np.rint(columns), 0, width - 1).astype(np.intp)
        there: Sequence[Float] = [plane.ravel().take(nearest) for plane in before.normal]
        counts &= sum(a * b for a, b in zip(there, turned, strict=True)) > NORMAL
    return old, counts.astype(np.float32)


def _neighbourhood(shade: Float, reach: int) -> tuple[Float, Float]:
    """(mean, standard deviation) of (C, H, W) over squares of 2 reach + 1 pixels a side."""
    mean = _box(shade, reach)
    centred = shade - mean  # the mean first, or small deviations of large values would be lost
    return mean, np.sqrt(np.maximum(_box(centred * centred, reach), 0))


def _box(image: Float, reach: int) -> Float:
    """The mean over squares; past the edges the last pixels are repeated."""
    side = 2 * reach + 1
    for axis in (-2, -1):
        pad = [(0, 0)] * image.ndim
        pad[axis] = (reach + 1, reach)
        sums = np.cumsum(np.pad(image, pad, "edge"), axis, dtype=np.float64)
        long = image.shape[axis]
        high = np.take(sums, np.arange(side, side + long), axis)
        low = np.take(sums, np.arange(long), axis)
        image = ((high - low) / side).astype(np.float32)
    return image
