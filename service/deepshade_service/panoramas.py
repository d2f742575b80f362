"""Panoramas, shaded as what shaders have learnt: pinhole views that look every way.

Six square views along the axes, wider than they must be, so that each sees what lies beside its
share of the sphere. Their pixels are the panorama's nearest, turned into each view's own space.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.attributes import ATTRIBUTES, CAMERA_DIRECTION, PIXELS, POINT, SCREEN_MOTION
from deepshade.bundles import Bundle
from deepshade.camera import Camera
from deepshade.gbuffer import GBuffer
from deepshade_service.problems import Problem

Float = NDArray[np.float32]

FOV = 120.0  # degrees; 90 would do without what lies beside
_FINER = 1.25  # than the panorama's pixels where it is finest


@dataclass(frozen=True, slots=True)
class Face:
    """One view: its G-buffer, and where in it (rows, columns) lie the pixels `of` the panorama."""

    gbuffer: GBuffer
    of: NDArray[np.bool_]
    at: tuple[NDArray[np.intp], NDArray[np.intp]]


def is_panorama(gbuffer: GBuffer) -> bool:
    """Whether it goes all around."""
    return gbuffer.camera is not None and gbuffer.camera.projection == "latlong"


def check(bundle: Bundle) -> None:
    """Raises Problem 422 for an effect that works in pixels of a flat picture."""
    flat = [n for n in bundle.inputs if ATTRIBUTES[n].unit in (PIXELS, SCREEN_MOTION)]
    if flat or "depth" in bundle.inputs:
        raise Problem(
            422,
            "unusable-input",
            f"'{bundle.effect}' is of a flat picture's pixels, and this is a panorama",
            fix="render it as flat pictures, or leave the effect out",
        )


def measured(gbuffer: GBuffer) -> GBuffer:
    """The panorama with the distance as its depth, by which a radius is chosen."""
    if "position" not in gbuffer.attributes:
        return gbuffer
    points = gbuffer.attributes["position"]
    distance = np.sqrt((points * points).sum(0, keepdims=True))
    return replace(gbuffer, attributes={"depth": distance})


def faces(gbuffer: GBuffer) -> Iterator[Face]:
    """The six views that between them hold every pixel of the panorama once."""
    around = gbuffer.camera
    assert around is not None, "a panorama has a camera"
    height, width = gbuffer.shape
    half = math.tan(math.radians(FOV) / 2)
    size = max(8, math.ceil(_FINER * 2 * half * around.width / (2 * math.pi)))
    rays = around.rays(width, height)
    nearest = np.abs(rays).argmax(0)
    for axis in range(3):
        for sign in (1, -1):
            of = (nearest == axis) & (np.sign(np.take(rays, axis, 0)) == sign)
            if not of.any():
                continue
            turn = _turn(axis, sign)
            camera = Camera(FOV, size, size, _matrix(turn, around))
            seen = turn @ rays[:, of]
            columns = np.clip((seen[0] / -seen[2] / half + 1) / 2 * size, 0, size - 1)
            rows = np.clip((1 - seen[1] / -seen[2] / half) / 2 * size, 0, size - 1)
            at = rows.astype(np.intp), columns.astype(np.intp)
            yield Face(_looking(gbuffer, around, camera, turn), of, at)


def _looking(
    gbuffer: GBuffer, around: Camera, camera: Camera, turn: NDArray[np.float64]
) -> GBuffer:
    """What a view of that `camera`, `turn`ed from the panorama's, sees of it."""
    rays = camera.rays().astype(np.float64)
    there = np.tensordot(turn.T, rays, 1)
    there /= np.sqrt((there * there).sum(0))
    longitude = np.arctan2(there[0], -there[2])
    latitude = np.arcsin(np.clip(there[1], -1, 1))
    columns = np.floor((longitude / (2 * math.pi) + 0.5) * around.width) % around.width
    rows = np.minimum(np.floor((0.5 - latitude / math.pi) * around.height), around.height - 1)
    columns, rows = columns - around.x0, rows - around.y0
    height, width = gbuffer.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    y = np.clip(rows, 0, height - 1).astype(np.intp)
    x = np.clip(columns, 0, width - 1).astype(np.intp)
    empty = gbuffer.background[y, x] | ~inside
    attributes: dict[str, Float] = {}
    for name, array in gbuffer.attributes.items():
        values: NDArray[Any] = array[:, y, x]
        unit = ATTRIBUTES[name].unit
        if unit is POINT:  # as far away as the nearest pixel's, on the ray of its own
            distance = np.sqrt((values.astype(np.float64) ** 2).sum(0))
            values = rays / np.sqrt((rays * rays).sum(0)) * distance
        elif unit is CAMERA_DIRECTION:
            values = np.tensordot(turn, values, 1)
        if not ATTRIBUTES[name].in_background:
            values = np.where(empty, 0, values)
        attributes[name] = np.ascontiguousarray(values, np.float32)
    return replace(gbuffer, attributes=attributes, background=empty, camera=camera)


def _turn(axis: int, sign: int) -> NDArray[np.float64]:
    """From the panorama's space to that of a view along an axis, (3, 3)."""
    ahead = np.eye(3)[axis] * sign
    up = np.array([0.0, 0, 1 if sign > 0 else -1]) if axis == 1 else np.array([0.0, 1, 0])
    return np.stack([np.cross(ahead, up), up, -ahead])


def _matrix(turn: NDArray[np.float64], around: Camera) -> NDArray[np.float64] | None:
    if around.world_to_camera is None:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    return matrix @ around.world_to_camera
