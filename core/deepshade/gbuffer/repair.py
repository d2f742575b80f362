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

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]

ROUNDS = 40  # of Jacobi's method
_STRIP = 96  # rows worked on at a time, beside those that may tell of them
_ENOUGH = 200  # pixels that a step, or how it was rounded, is told by
_GRAZING = 0.02  # cosine below which a normal's plane says nothing of depth
_SLACK = 0.25  # of an interval: its ends are as exact as the pixels' rays
_CONSISTENT = 0.85  # share of pixels whose three intervals must meet
_SAMPLE = 1500  # pixels that steps are looked for in
_FINE = 300  # steps in a radius that do no harm
_FINE_DEPTH = 60  # those of depth alone: it errs along the ray, where it is seen least
_SOURCES = ("position", "position_world", "depth")  # the first is taken
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


def intervals(
    stored: NDArray[Any], rays: NDArray[Any], eye: NDArray[np.float64], steps: Steps
) -> tuple[NDArray[Any], NDArray[Any]]:
    """(least, greatest) planar depth that `stored` positions (3, ...) may have, where x, y and z
    agree; the least is above the greatest where they don't.

    They are seen along `rays` (3, ...), of length 1 along the view axis, from the `eye` (3,).
    """
    low = np.zeros(stored.shape[1:], np.float32)
    high = np.full(stored.shape[1:], np.inf, np.float32)
    for axis in range(3):
        values, ray = stored[axis], rays[axis]
        step = steps.of(values, axis)
        bias = np.float32(steps.bias[axis])
        sign = np.where(values < 0, -bias, bias) if steps.towards_zero else bias
        middle = (values - sign * step - np.float32(eye[axis])) / ray
        wide = np.abs((0.5 + _SLACK) * step / ray)
        np.fmax(low, middle - wide, out=low)
        np.fmin(high, middle + wide, out=high)
    return low, high


def between(
    low: Float,
    high: Float,
    valid: Mask,
    normals: tuple[Float, Float] | None,
    *,
    rounds: int = ROUNDS,
) -> Float:
    """Smooth depths (H, W) between `low` and `high`, 0 where not `valid`.

    `normals` are those (3, H, W) of the surfaces, and the pixels' rays in their space.
    """
    with np.errstate(all="ignore"):
        usable = valid & (low > 0) & np.isfinite(high)
        depth = 0.5 * (low + high)
        if normals is not None:
            smooth = np.exp(_smoothed(np.log(low), np.log(high), *normals, usable, rounds))
        else:  # a plane's 1 / depth is linear in the picture: the mean of its neighbours
            minus = np.float32(-1)
            smooth = minus / _evened(minus / low, minus / high, usable, rounds)
        np.copyto(depth, smooth, where=usable)
    depth[~(valid & np.isfinite(depth))] = 0
    return depth


_Half = tuple[slice, slice]
_SIDES: tuple[tuple[_Half, _Half], ...] = (  # pixels, and their neighbours to the right and below
    ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
    ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
)


def _smoothed(
    low: Float, high: Float, normals: Float, rays: Float, usable: Mask, rounds: int
) -> Float:
    """Logarithms of depth between `low` and `high` that go on as the normals' planes say."""
    facing = usable & ((normals * rays).sum(0) < -_GRAZING)
    changes, links = [], []
    for here, there in _SIDES:
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
        changes.append(np.where(joined, change, 0))
        links.append(joined)
    return _relaxed(low, high, changes, links, usable, rounds)


def _evened(low: Float, high: Float, usable: Mask, rounds: int) -> Float:
    """Values between `low` and `high` that are the mean of their neighbours'."""
    links = []
    for here, there in _SIDES:
        wide = 0.5 * (high[here] - low[here] + high[there] - low[there])
        joined = usable[here] & usable[there]
        joined &= (low[here] - wide <= high[there]) & (high[here] + wide >= low[there])
        links.append(joined)
    none = [np.zeros(link.shape, np.float32) for link in links]
    return _relaxed(low, high, none, links, usable, rounds)


def _relaxed(
    low: Float, high: Float, changes: list[Float], links: list[Mask], usable: Mask, rounds: int
) -> Float:
    """By Jacobi's method, between `low` and `high`: each the mean of what its neighbours to the
    right and below, and left and above, by these `changes`, say of it where they are linked."""
    weight = np.zeros(usable.shape, np.float32)
    constant = np.zeros(usable.shape, np.float32)
    for (here, there), change, joined in zip(_SIDES, changes, links, strict=True):
        weight[there] += joined
        weight[here] += joined
        constant[there] += change
        constant[here] -= change
    share = 1 / np.maximum(weight, 1)
    constant *= share
    low, high = np.where(usable, low, 0), np.where(usable, high, 0)
    values = 0.5 * (low + high)
    np.copyto(constant, values, where=weight == 0)  # what has no neighbour stays
    shares = [
        (here, there, joined * share[there], joined * share[here])
        for (here, there), joined in zip(_SIDES, links, strict=True)
    ]
    total, part = np.empty_like(values), np.empty_like(values)
    for _ in range(rounds):
        total[...] = constant
        for here, there, onward, back in shares:
            for source, target, link in ((here, there, onward), (there, here, back)):
                product = part[: link.shape[0], : link.shape[1]]
                np.multiply(link, values[source], out=product)
                total[target] += product
        np.clip(total, low, high, out=values)
    return values


def repair(
    arrays: Mapping[str, Float],
    valid: Mask,
    camera: Camera | None,
    matrix: NDArray[np.float64] | None,
    radius: float | None,
) -> dict[str, str]:
    """Smooths positions among the `arrays` whose steps are coarse, in place; what was done.

    Coarse is a step over a 300th of `radius` (of depth alone: a 60th), by default 15 % of the
    median depth. `valid` (H, W) is where there are surfaces.
    """
    name = next((name for name in _SOURCES if name in arrays), "")
    if not name or (name == "position_world" and matrix is None):
        return {}
    # an odd number, so that they don't all lie in a few columns
    pixels = np.arange(0, valid.size, (valid.size // _SAMPLE) | 1)
    pixels = pixels[valid.ravel()[pixels]]
    some = arrays[name].reshape(len(arrays[name]), -1)[:, pixels]
    if name == "depth":
        return _depth(arrays, some[0], valid, camera, matrix, radius)
    # most files are finer, which depth alone tells
    if lattice(some[2]) is None:
        return {}
    step = [size for size in map(lattice, some) if size is not None]
    if len(step) < 3:
        return {}
    linear, offset = np.eye(3), np.zeros(3)
    if name == "position_world" and matrix is not None:
        linear, offset = matrix[:3, :3], matrix[:3, 3]
    seen = linear @ some + offset[:, None]
    steps = Steps((step[0], step[1], step[2]), (0.0, 0.0, 0.0))
    coarse = max(float(np.median(steps.of(some[axis], axis))) for axis in range(3))
    reach = radius or _SHARE * float(np.median(np.abs(seen[2])))
    if not coarse > reach / _FINE:
        return {}
    inverse = np.linalg.inv(linear)
    eye = -inverse @ offset
    for slopes in _rays(camera, seen, pixels, valid.shape, coarse):
        there = inverse @ _of(slopes, valid.shape, pixels)
        known = steps_of(some, there, eye, steps.step)
        with np.errstate(all="ignore"):
            low, high = intervals(some, there, eye, known)
        if (low <= high).mean() < _CONSISTENT:
            continue  # they don't lie on these rays, within their steps
        turned = inverse.astype(np.float32)
        depth = np.empty(valid.shape, np.float32)
        for inner, rows, kept in _strips(valid.shape[0]):
            rays = _strip(slopes, rows)
            with np.errstate(all="ignore"):
                given = np.tensordot(turned, rays, 1)
                low, high = intervals(arrays[name][:, rows], given, eye, known)
                low, high = np.fmin(low, high), np.fmax(low, high)
            normals = _normals(arrays, rays, matrix, rows)
            depth[inner] = between(low, high, valid[rows], normals)[kept]
        for rows, _, _ in _strips(valid.shape[0]):
            given = np.tensordot(turned, _strip(slopes, rows), 1)
            for axis in range(3):
                placed = given[axis] * depth[rows] + np.float32(eye[axis])
                np.copyto(arrays[name][axis, rows], placed, where=depth[rows] > 0)
        return {name: f"stored in steps of {coarse:.2g}; smoothed within them"}
    return {}


def _strips(height: int) -> Iterator[tuple[slice, slice, slice]]:
    """Rows, those that tell of them, and the first among the second: so that whole pictures and
    strips come out alike, in less memory."""
    for top in range(0, height, _STRIP):
        end, above = min(top + _STRIP, height), max(top - ROUNDS, 0)
        yield (
            slice(top, end),
            slice(above, min(end + ROUNDS, height)),
            slice(top - above, end - above),
        )


def _depth(
    arrays: Mapping[str, Float],
    some: Float,
    valid: Mask,
    camera: Camera | None,
    matrix: NDArray[np.float64] | None,
    radius: float | None,
) -> dict[str, str]:
    """`repair` of planar depth: one measurement, rounded or cut off."""
    step = lattice(some)
    if camera is None or step is None:
        return {}
    known = Steps((step, step, step), (0.0, 0.0, 0.0))
    coarse = float(np.median(known.of(some, 0)))
    if not coarse > (radius or _SHARE * float(np.median(some))) / _FINE_DEPTH:
        return {}
    stored = arrays["depth"][0]
    slopes = _slopes(camera, valid.shape)
    depth = np.empty(valid.shape, np.float32)
    for inner, rows, kept in _strips(valid.shape[0]):
        values = stored[rows]
        size = known.of(values, 0)
        normals = _normals(arrays, _strip(slopes, rows), matrix, rows)
        ends = values - (0.5 + _SLACK) * size, values + (1 + _SLACK) * size
        depth[inner] = between(*ends, valid[rows], normals)[kept]
    np.copyto(stored, depth, where=depth > 0)
    return {"depth": f"stored in steps of {coarse:.2g}; smoothed within them"}


def _normals(
    arrays: Mapping[str, Float], rays: Float, matrix: NDArray[np.float64] | None, rows: slice
) -> tuple[Float, Float] | None:
    """Normals of some rows, and the camera's rays in their space."""
    if "normal" in arrays:
        return arrays["normal"][:, rows], rays
    if "normal_world" in arrays and matrix is not None:
        turned = np.tensordot(rotation_of(matrix).T.astype(np.float32), rays, 1)
        return arrays["normal_world"][:, rows], turned
    return None


# x / -z of a picture's columns (W,), and y / -z of its rows (H,)
_Slopes = tuple[NDArray[np.float64], NDArray[np.float64]]


def _slopes(camera: Camera, shape: Any) -> _Slopes:
    height, width = shape
    none = np.zeros(1, np.intp)
    x = camera.rays_at(np.arange(width), np.broadcast_to(none, width))[0]
    return x, camera.rays_at(np.broadcast_to(none, height), np.arange(height))[1]


def _of(slopes: _Slopes, shape: Any, pixels: NDArray[np.intp]) -> NDArray[np.float64]:
    """The rays (3, N) of `pixels`."""
    x, y = slopes[0][pixels % shape[1]], slopes[1][pixels // shape[1]]
    return np.stack([x, y, np.full(x.shape, -1.0)])


def _strip(slopes: _Slopes, rows: slice) -> Float:
    """The rays (3, h, W) of some rows."""
    x, y = slopes[0], slopes[1][rows]
    rays = np.full((3, y.size, x.size), -1, np.float32)
    rays[0], rays[1] = x, y[:, None]
    return rays


def _rays(
    camera: Camera | None,
    seen: NDArray[np.float64],
    pixels: NDArray[np.intp],
    shape: Any,
    coarse: float,
) -> Iterator[_Slopes]:
    """The rays that positions in camera space may lie on: the camera's; their own."""
    height, width = shape
    if camera is not None:
        yield _slopes(camera, shape)
    x, y = (
        _own(seen[axis], -seen[2], at, coarse)
        for axis, at in enumerate(divmod(pixels, width)[::-1])
    )
    yield x[0] * np.arange(width) + x[1], y[0] * np.arange(height) + y[1]


def _own(
    values: NDArray[np.float64], depth: NDArray[np.float64], at: NDArray[np.intp], step: float
) -> tuple[float, float]:
    """(slope, offset) of the rays of pixels `at` that positions lie on, by least squares.

    x = (a at + b) d, each of x and d off by the same part of a step everywhere, which makes two
    more unknowns; that they are below a step is as good as one measurement of each.
    """
    middle = at.mean()
    pixel = at - middle
    span = step / max(1.0, float(np.abs(pixel).max()))
    columns = np.stack([depth * pixel, depth, pixel * span, np.full(at.shape, step)], 1)
    prior = 0.3 * step * np.eye(4)[2:]
    known = np.concatenate([columns, prior]), np.concatenate([values, np.zeros(2)])
    a, b, *_ = np.linalg.lstsq(*known, rcond=None)[0]
    off = np.abs(values - columns[:, :2] @ (a, b))
    near = off <= 4 * np.median(off)
    columns, values = columns[near], values[near]
    known = np.concatenate([columns, prior]), np.concatenate([values, np.zeros(2)])
    a, b, *_ = np.linalg.lstsq(*known, rcond=None)[0]
    return float(a), float(b - a * middle)
