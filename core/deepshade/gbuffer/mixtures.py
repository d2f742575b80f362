"""Pixels in which a filter, or a lens, has mixed surfaces with each other or with nothing.

A G-buffer should hold one sample a pixel. Where a reconstruction filter has gone over it, pixels
along silhouettes hold means: shorter normals, and depths at which there is no surface. Their
neighbours further in are whole, and tell what they would be.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.gbuffer.background import DEPTHS, FAR
from deepshade.gbuffer.conventions import NORMALS

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]

_WHOLE = 0.97  # length of normals that aren't mixed, and coverage of pixels that are whole
_ROWS = 32  # so many rows at least are looked at first, and every 16th of a large picture
_EDGE = 0.9  # coverage that pixels beside nothing have at most, where a filter was at work
_INSIDE = 0.3  # share of all others that may be mixed all the same: other edges, bumps
_LEAST = 8  # pixels beside nothing that tell
_REACH = 2  # pixels: how far a filter mixes, and how far off a whole neighbour may be
_HALF = 0.5  # coverage from which on a pixel shows the surface
_PLACES = ("position", "position_world")
# neighbours, the nearest first
_RINGS = sorted(
    (
        (y, x)
        for y in range(-_REACH, _REACH + 1)
        for x in range(-_REACH, _REACH + 1)
        if (y, x) != (0, 0)
    ),
    key=lambda at: (max(abs(at[0]), abs(at[1])), abs(at[0]) + abs(at[1])),
)


@np.errstate(all="ignore")
def unmix(arrays: Mapping[str, Float]) -> tuple[dict[str, str], str]:
    """Repairs mixed pixels of stored quantities (C, H, W), read as ours, in place.

    (What was done to each, by its name; a warning, or "".) Those that show the surface by half
    take what their whole neighbours say, the others show nothing. Without a whole neighbour in
    reach those beside nothing are divided by their coverage, and the others stay as they are.
    """
    step = min(16, max(1, next(iter(arrays.values())).shape[1] // _ROWS))
    if not _filtered({name: array[:, ::step] for name, array in arrays.items()}):
        return {}, ""
    coverage, empty = _coverage(arrays)
    mixed = ~empty & (coverage < _WHOLE) & _near(empty | _cliffs(arrays, empty), _REACH)
    rows, columns = np.nonzero(mixed)
    if not rows.size:
        return {}, ""
    whole = ~empty & ~mixed
    beside = _near(empty, _REACH)[mixed]
    gone = beside & (coverage[mixed] < _HALF)
    sources, further = _neighbours(arrays, rows, columns, whole)
    found = ~gone & (sources >= 0)
    at, near, far = (rows[found], columns[found]), sources[found], further[found]
    nothing = empty.copy()
    nothing[rows[gone], columns[gone]] = True
    notes: dict[str, str] = {}
    thin = beside & ~gone & ~found  # mixed with nothing alone: all of it is shorter alike
    share = (gone | found | thin).sum() / empty.size
    for name, array in arrays.items():
        if name not in (*NORMALS, *DEPTHS, *_PLACES):
            continue
        flat = array.reshape(len(array), -1)
        values: NDArray[Any] = flat[:, near]
        other = flat[:, far]
        if name in _PLACES:
            values = np.float32(2) * values - other
        elif name in DEPTHS:
            values = np.float32(1) / (np.float32(2) / values - np.float32(1) / other)
        array[:, *at] = values
        array[:, rows[thin], columns[thin]] /= coverage[rows[thin], columns[thin]]
        array[:, nothing] = 0
        notes[name] = f"{share:.1%} of the pixels were mixed; taken from whole neighbours"
    left = int(rows.size - (gone | found | thin).sum())
    text = (
        f"a filter or a lens has mixed surfaces in {rows.size / empty.size:.1%} of the pixels; "
        + (f"{left} of them stay so" if left else "they were repaired from their neighbours")
        + ": render attributes with one sample a pixel, without a filter or depth of field"
    )
    return notes, text


def _filtered(some: Mapping[str, Float]) -> bool:
    """Whether the pixels beside nothing, in some rows, are mixed, and the others aren't."""
    coverage, empty = _coverage(some, vertical=False)
    left = np.zeros_like(empty)
    left[:, 1:] = empty[:, :-1]
    left[:, :-1] |= empty[:, 1:]
    edge = left & ~empty
    count = int(np.count_nonzero(edge))
    if count < _LEAST:
        return False
    short = ~empty & (coverage < _WHOLE)
    inside = ~_near(empty, _REACH + 1, vertical=False) & ~empty
    if not np.median(coverage[edge]) < _EDGE:
        return False
    return bool(np.count_nonzero(short & inside) <= _INSIDE * max(1, int(inside.sum())))


def _coverage(arrays: Mapping[str, Float], *, vertical: bool = True) -> tuple[Float, Mask]:
    """(how much of each pixel (H, W) shows a surface, where nothing does).

    Rows that don't lie beside each other aren't to be compared: not `vertical`.
    """
    name = next((name for name in NORMALS if name in arrays), "")
    if name:
        normals = arrays[name]
        coverage = np.sqrt((normals * normals).sum(0))
        return coverage, ~(coverage > 0.02)
    name = next((name for name in DEPTHS if name in arrays), "")
    if not name:
        shape = next(iter(arrays.values())).shape[1:]
        return np.ones(shape, np.float32), np.zeros(shape, np.bool_)
    depth = arrays[name][0]
    empty = ~((depth > 0) & (depth < FAR))
    # what falls off from a surface on the one side to nothing on the other is mixed with it
    coverage = np.ones_like(depth)
    for axis in (0, 1) if vertical else (1,):
        for side in (1, -1):
            beside = np.zeros_like(empty)
            for far in range(1, _REACH + 1):
                beside |= _shifted(empty, side * far, axis, False)
            inner = _shifted(np.where(empty, np.nan, depth), -side * _REACH, axis, np.nan)
            share = np.where(beside & (depth < inner), depth / inner, 1)
            np.minimum(coverage, share, out=coverage)
    return coverage, empty


def _shifted(array: NDArray[Any], by: int, axis: int, fill: Any) -> NDArray[Any]:
    """What lies `by` pixels further along the axis; `fill` past the end."""
    moved = np.full_like(array, fill)
    here, there = [slice(None)] * 2, [slice(None)] * 2
    here[axis], there[axis] = slice(None, -by or None), slice(by, None)
    if by < 0:
        here[axis], there[axis] = slice(-by, None), slice(None, by)
    moved[tuple(here)] = array[tuple(there)]
    return moved


def _cliffs(arrays: Mapping[str, Float], empty: Mask) -> Mask:
    """Where depth jumps from one pixel to the next."""
    cliff = np.zeros_like(empty)
    name = next((name for name in DEPTHS if name in arrays), "")
    if name:
        depth = np.log(np.where(empty, np.nan, arrays[name][0]))
    elif "position" in arrays:
        depth = np.log(np.where(empty, np.nan, -arrays["position"][2]))
    else:
        return cliff
    for here, there in (
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:], np.s_[:-1]),
    ):
        jump = np.abs(depth[here] - depth[there]) > 0.05
        cliff[here] |= jump
        cliff[there] |= jump
    return cliff


def _near(mask: Mask, reach: int, *, vertical: bool = True) -> Mask:
    """Where the mask is true within so many pixels."""
    near = mask.copy()
    for _ in range(reach):
        for axis in (0, 1) if vertical else (1,):
            before, after = [slice(None)] * 2, [slice(None)] * 2
            before[axis], after[axis] = slice(1, None), slice(None, -1)
            grown = near.copy()
            grown[tuple(before)] |= near[tuple(after)]
            grown[tuple(after)] |= near[tuple(before)]
            near = grown
    return near


def _neighbours(
    arrays: Mapping[str, Float], rows: NDArray[np.intp], columns: NDArray[np.intp], whole: Mask
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For pixels the numbers of a whole neighbour on their surface (-1 for none), and of the one
    behind it, along which its values go on, or else of itself.

    Of equally near ones that whose normal is the most like the mixed one's.
    """
    height, width = whole.shape
    name = next((name for name in NORMALS if name in arrays), "")
    normals = arrays[name] if name else np.ones((1, height, width), np.float32)
    mine = normals[:, rows, columns]
    sources = np.full(rows.size, -1, np.intp)
    further = np.full(rows.size, -1, np.intp)
    best = np.full(rows.size, -np.inf)
    ring = np.full(rows.size, _REACH + 1)
    for dy, dx in _RINGS:
        y, x = rows + dy, columns + dx
        size = max(abs(dy), abs(dx))
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        y, x = np.where(inside, y, 0), np.where(inside, x, 0)
        alike = (mine * normals[:, y, x]).sum(0)
        better = inside & whole[y, x] & (size <= ring) & (alike > best)
        y2, x2 = y + dy, x + dx
        behind = (y2 >= 0) & (y2 < height) & (x2 >= 0) & (x2 < width)
        y2, x2 = np.where(behind, y2, y), np.where(behind, x2, x)
        same = (normals[:, y, x] * normals[:, y2, x2]).sum(0) > 0.9 * len(normals) ** 0
        on = behind & whole[y2, x2] & same & _continues(arrays, (y, x), (y2, x2))
        sources = np.where(better, y * width + x, sources)
        further = np.where(better, np.where(on, y2 * width + x2, y * width + x), further)
        best, ring = np.where(better, alike, best), np.where(better, size, ring)
    return sources, further


def _continues(arrays: Mapping[str, Float], here: Any, there: Any) -> Mask:
    """Whether depth doesn't jump between pixels."""
    name = next((name for name in DEPTHS if name in arrays), "")
    if not name:
        return np.ones(here[0].shape, np.bool_)
    depth = arrays[name][0]
    return np.asarray(np.abs(np.log(depth[here] / depth[there])) < 0.1)
