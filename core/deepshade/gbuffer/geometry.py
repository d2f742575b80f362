"""Geometry of images of positions: normals by differences, unit vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_STRIP = 32  # rows worked on at a time, so that they stay in the CPU's cache


def normals_from_positions(position: Array, valid: NDArray[np.bool_]) -> Array:
    """N_s, unit (3, H, W), from camera-space positions (3, H, W), facing the camera.

    In each direction the neighbour on the same surface counts: of the two one-sided differences
    the one whose depth continues more plainly. "More plainly" is second order where there is
    room: the difference that its own further neighbour predicts best; else the smaller change in
    depth. Where no neighbour is valid the normal faces the camera; invalid pixels give 0.
    """
    height = valid.shape[0]
    normal = np.empty(position.shape, np.float32)
    for top in range(0, height, _STRIP):
        # differences reach two pixels far
        above, end = max(top - 2, 0), min(top + _STRIP, height)
        rows = slice(above, min(end + 2, height))
        strip = _normals_of_strip(position[:, rows], valid[rows])
        normal[:, top:end] = strip[:, top - above : end - above]
    return normal


def _normals_of_strip(position: Array, valid: NDArray[np.bool_]) -> Array:
    p = np.where(valid, position, 0).astype(np.float32, copy=False)
    across = _difference(p, valid, axis=2)
    down = _difference(p, valid, axis=1)
    # rows run down: right x (-down) points to the camera on a wall that faces it
    normal = np.empty_like(p)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        normal[i] = down[j] * across[k] - down[k] * across[j]
    toward = unit(-p)
    length = np.sqrt((normal * normal).sum(0))
    # relative to the edges' lengths, so that tiny and huge scenes alike have a threshold
    size = np.sqrt((across * across).sum(0)) * np.sqrt((down * down).sum(0))
    flat = length <= 1e-7 * size
    flip = (normal * toward).sum(0) < 0
    scale = np.where(flip, -1.0, 1.0) / np.where(flat, 1.0, length)
    normal *= scale.astype(np.float32)
    np.copyto(normal, toward, where=flat)
    np.copyto(normal, 0, where=~valid)
    return normal


def unit(vectors: Array) -> Array:
    """Vectors (3, H, W) scaled to length 1; those of length 0 stay 0."""
    # divide by the largest component first, so that squares neither overflow nor vanish
    largest = np.abs(vectors).max(0)
    scaled = vectors / np.where(largest > 0, largest, 1)
    length = np.sqrt((scaled * scaled).sum(0))
    scaled /= np.where(length > 0, length, 1)
    return np.asarray(scaled, np.float32)


def _difference(p: Array, valid: NDArray[np.bool_], axis: int) -> Array:
    """The better of the forward and backward differences of positions along an axis; 0 if none."""
    p = np.moveaxis(p, axis, 2)
    valid = np.moveaxis(valid, axis - 1, 1)
    forward, backward = np.zeros_like(p), np.zeros_like(p)
    step = p[:, :, 1:] - p[:, :, :-1]
    both = valid[:, 1:] & valid[:, :-1]
    step = np.where(both, step, 0)
    forward[:, :, :-1] = step
    backward[:, :, 1:] = step
    has_forward, has_backward = np.zeros_like(valid), np.zeros_like(valid)
    has_forward[:, :-1] = both
    has_backward[:, 1:] = both

    # depth's reciprocal is linear across a plane in the image, so its kinks mark the edges
    z = p[2]
    inverse = np.divide(1.0, z, out=np.zeros_like(z), where=z != 0)
    slope = np.where(both, inverse[:, 1:] - inverse[:, :-1], 0)
    cost_forward, cost_backward = np.full_like(z, np.inf), np.full_like(z, np.inf)
    cost_forward[:, :-1] = np.where(both, np.abs(slope), np.inf)
    cost_backward[:, 1:] = np.where(both, np.abs(slope), np.inf)
    bend = np.abs(slope[:, 1:] - slope[:, :-1])
    chain = both[:, 1:] & both[:, :-1]
    # pixels with two more neighbours on both sides compare how straight either side goes on
    kink_forward, kink_backward = np.full_like(z, np.inf), np.full_like(z, np.inf)
    kink_forward[:, :-2] = np.where(chain, bend, np.inf)
    kink_backward[:, 2:] = np.where(chain, bend, np.inf)
    straight = np.isfinite(kink_forward) & np.isfinite(kink_backward)
    use_forward = np.where(straight, kink_forward <= kink_backward, cost_forward <= cost_backward)
    use_forward &= has_forward
    use_forward |= ~has_backward
    return np.moveaxis(np.where(use_forward, forward, backward), 2, axis)
