"""Positions of few bits made smooth again, as far as what is stored allows.

A stored number stands for all that were rounded to it. A pinhole camera makes x, y and z three
measurements of one depth, whose intervals are intersected; in what is left, depth goes on from
pixel to pixel as the planes of the normals say.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera, rotation_of
from deepshade.gbuffer.pairs import projection

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]

ROUNDS = 60  # of Jacobi's method
_ENOUGH = 200  # pixels that a step, or how it was rounded, is told by
_GRAZING = 0.02  # cosine below which a normal's plane says nothing of depth
_SLACK = 0.25  # of an interval: its ends are as exact as the pixels' rays
_CONSISTENT = 0.85  # share of pixels whose three intervals must meet
_SAMPLE = 1500  # pixels that steps are looked for in
_FINE = 300  # steps in a radius that do no harm
_SHARE = 0.15  # of the median depth: the radius where none is known


@dataclass(frozen=True, slots=True)
class Steps:
    """How stored positions were rounded: an axis' step, 0 where it is that of 16-bit floats, and
    the mean error of a stored number in steps: 0 rounded, -1/2 cut off, +1/2 the other way.
    `towards_zero`: for negative numbers the other way round."""

    step: tuple[float, float, float]
    bias: tuple[float, float, float]
    towards_zero: bool = False

    def of(self, values: NDArray[Any], axis: int) -> NDArray[Any]:
        """The step at each of an axis' values."""
        if self.step[axis]:
            return np.full(values.shape, self.step[axis], values.dtype)
        return np.abs(np.spacing(values.astype(np.float16))).astype(values.dtype)


def lattice(values: NDArray[np.floating[Any]]) -> float | None:
    """The step of which all `values` (N,) of an axis are multiples, but for an offset; 0 where they
    are 16-bit floats; None where they are finer."""
    values = values[np.isfinite(values)]
    if values.size < _ENOUGH:
        return None
    with np.errstate(over="ignore"):
        if (values.astype(np.float16) == values).all():
            return 0.0
    found = np.unique(values.astype(np.float64))
    gaps = np.diff(found)
    if found.size < 8 or found.size > 0.7 * values.size:
        return None
    # neighbours in value are mostly one step apart; what rounding leaves beside is less
    tiny = 4 * float(np.spacing(np.float32(np.abs(found).max())))
    gaps = gaps[gaps > tiny]
    if gaps.size < 2:
        return None
    step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
    off = np.abs(gaps / step - np.round(gaps / step))
    return step if float(np.median(off)) < 0.05 + tiny / step else None


def steps_of(
    stored: NDArray[np.floating[Any]],
    rays: NDArray[np.floating[Any]],
    eye: NDArray[np.floating[Any]],
    step: tuple[float, float, float],
) -> Steps:
    """How some stored positions (3, N) on `rays` (3, N) were rounded, of these steps.

    Without rounding (x - eye_x) ray_z = (z - eye_z) ray_x, and alike for y; what it is off is the
    mean error of x and of z, each times the other's ray. Least squares give the three.
    """
    exact = stored.astype(np.float64) - eye[:, None]
    towards_zero = not any(step)
    guess = Steps(step, (0.0, 0.0, 0.0))
    size = np.stack([guess.of(values, axis) for axis, values in enumerate(stored)])
    if towards_zero:
        size *= np.sign(stored)
    rows, off = [], []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        equation = np.zeros((3, stored.shape[1]))
        equation[i], equation[j] = size[i] * rays[j], -size[j] * rays[i]
        scale = np.hypot(equation[i], equation[j]) + 1e-30
        rows.append(equation / scale)
        off.append((exact[i] * rays[j] - exact[j] * rays[i]) / scale)
    matrix, target = np.concatenate(rows, 1).T, np.concatenate(off)
    usual = np.abs(target) < 3  # in steps: not where the ray shows two surfaces
    bias = np.linalg.lstsq(matrix[usual], target[usual], rcond=None)[0]
    x, y, z = (float(np.clip(np.round(2 * each) / 2, -0.5, 0.5)) for each in bias)
    return Steps(step, (x, y, z), towards_zero)


@dataclass(frozen=True, slots=True)
class View:
    """How positions are seen, in their own space: along `rays` (3, H, W), of length 1 along the
    view axis, from the `eye` (3,)."""

    rays: Float
    eye: NDArray[np.float64]


def repaired(
    stored: Float,
    view: View,
    steps: Steps,
    valid: Mask,
    normals: tuple[Float, Float] | None,
    *,
    rounds: int = ROUNDS,
) -> Float | None:
    """Planar depths (H, W) of `stored` positions (3, H, W), 0 where not `valid`, or None.

    `normals` are those (3, H, W) of the surfaces and the rays in their space, which need not be the
    positions'; without them only the intervals are intersected. None where the positions don't lie
    on the rays, within their steps.
    """
    low, high = np.zeros(valid.shape, np.float32), np.full(valid.shape, np.inf, np.float32)
    with np.errstate(all="ignore"):
        for axis in range(3):
            values, ray = stored[axis], view.rays[axis]
            step = steps.of(values, axis)
            bias = np.float32(steps.bias[axis])
            sign = np.where(values < 0, -bias, bias) if steps.towards_zero else bias
            middle = (values - sign * step - np.float32(view.eye[axis])) / ray
            wide = np.abs((0.5 + _SLACK) * step / ray)
            np.fmax(low, middle - wide, out=low)
            np.fmin(high, middle + wide, out=high)
        met = np.count_nonzero((low <= high) & valid)
        if met < _CONSISTENT * np.count_nonzero(valid):
            return None
        low, high = np.fmin(low, high), np.fmax(low, high)
        usable = valid & (low > 0) & np.isfinite(high)
        depth = 0.5 * (low + high)
        if normals is not None:
            smooth = np.exp(_smoothed(np.log(low), np.log(high), *normals, usable, rounds))
            np.copyto(depth, smooth, where=usable)
    depth[~(valid & np.isfinite(depth))] = 0
    return depth


def _smoothed(
    low: Float, high: Float, normals: Float, rays: Float, usable: Mask, rounds: int
) -> Float:
    """Logarithms of depth between `low` and `high` that go on as the normals' planes say."""
    facing = usable & ((normals * rays).sum(0) < -_GRAZING)
    weight = np.zeros(usable.shape, np.float32)
    links: list[tuple[tuple[slice, slice], tuple[slice, slice], Float]] = []
    every, first, last = slice(None), slice(None, -1), slice(1, None)
    constant = np.zeros(usable.shape, np.float32)
    for here, there in (((every, first), (every, last)), ((first, every), (last, every))):
        a, b = (slice(None), *here), (slice(None), *there)
        crossed = (
            (normals[a] * rays[a]).sum(0) * (normals[b] * rays[a]).sum(0),
            (normals[a] * rays[b]).sum(0) * (normals[b] * rays[b]).sum(0),
        )
        # the planes' depth changes from here to there by this factor
        change = 0.5 * np.log(crossed[0] / crossed[1])
        joined = facing[here] & facing[there] & np.isfinite(change)
        # and only where it can: not across edges
        joined &= (low[here] + change <= high[there]) & (high[here] + change >= low[there])
        link = joined.astype(np.float32)
        change = np.where(joined, change, 0)
        links.append((here, there, link))
        weight[there] += link
        weight[here] += link
        constant[there] += change
        constant[here] -= change
    share = 1 / np.maximum(weight, 1)
    constant *= share
    low, high = np.where(usable, low, 0), np.where(usable, high, 0)
    depth = 0.5 * (low + high)
    np.copyto(constant, depth, where=weight == 0)  # what has no neighbour stays
    shares = [(here, there, link * share[there], link * share[here]) for here, there, link in links]
    total, part = np.empty_like(depth), np.empty_like(depth)
    for _ in range(rounds):
        total[...] = constant
        for here, there, onward, back in shares:
            for source, target, link in ((here, there, onward), (there, here, back)):
                product = part[: link.shape[0], : link.shape[1]]
                np.multiply(link, depth[source], out=product)
                total[target] += product
        np.clip(total, low, high, out=depth)
    return depth


def repair(
    arrays: Mapping[str, Float],
    valid: Mask,
    camera: Camera | None,
    matrix: NDArray[np.float64] | None,
    radius: float | None,
) -> dict[str, str]:
    """Smooths positions among the `arrays` whose steps are coarse, in place; what was done.

    Coarse is a step over a 300th of `radius`, by default 15 % of the median depth. `valid` (H, W)
    is where there are surfaces.
    """
    name = "position" if "position" in arrays else "position_world"
    if name not in arrays or (name == "position_world" and matrix is None):
        return {}
    # an odd number, so that they don't all lie in a few columns
    pixels = np.arange(0, valid.size, (valid.size // _SAMPLE) | 1)
    pixels = pixels[valid.ravel()[pixels]]
    some = arrays[name].reshape(3, -1)[:, pixels]
    # most files are finer, which depth alone tells
    if lattice(some[2]) is None:
        return {}
    step = [lattice(values) for values in some]
    if None in step:
        return {}
    linear, offset = np.eye(3), np.zeros(3)
    if name == "position_world" and matrix is not None:
        linear, offset = matrix[:3, :3], matrix[:3, 3]
    seen = linear @ some + offset[:, None]
    steps = Steps(tuple(step), (0.0, 0.0, 0.0))  # type: ignore[arg-type]
    coarse = max(float(np.median(steps.of(some[axis], axis))) for axis in range(3))
    reach = radius or _SHARE * float(np.median(np.abs(seen[2])))
    if not coarse > reach / _FINE:
        return {}
    inverse = np.linalg.inv(linear)
    eye = -inverse @ offset
    for rays in _rays(camera, seen, pixels, valid.shape):
        there = np.tensordot(inverse, rays, 1).astype(np.float32)
        known = steps_of(some, there.reshape(3, -1)[:, pixels], eye, steps.step)
        normals = None
        if "normal" in arrays:
            normals = arrays["normal"], rays
        elif "normal_world" in arrays and matrix is not None:
            turned = np.tensordot(rotation_of(matrix).T, rays, 1).astype(np.float32)
            normals = arrays["normal_world"], turned
        depth = repaired(arrays[name], View(there, eye), known, valid, normals)
        if depth is None:
            continue
        good = depth > 0
        for axis in range(3):
            placed = there[axis] * depth + np.float32(eye[axis])
            np.copyto(arrays[name][axis], placed, where=good)
        return {name: f"stored in steps of {coarse:.2g}; smoothed within them"}
    return {}


def _rays(
    camera: Camera | None, seen: NDArray[np.float64], pixels: NDArray[np.intp], shape: Any
) -> Iterator[Float]:
    """The rays (3, H, W) that positions in camera space may lie on: the camera's; their own."""
    height, width = shape
    if camera is not None:
        yield camera.rays(width, height)
    lines = projection(seen, pixels % width, pixels // width)
    if lines is not None:
        (right, left), (down, top) = lines
        rays = np.empty((3, height, width), np.float32)
        rays[0] = left + right * np.arange(width)
        rays[1] = (top + down * np.arange(height))[:, None]
        rays[2] = -1
        yield rays
