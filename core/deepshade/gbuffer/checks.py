"""A G-buffer checked against itself: a grid of its pixels tells how its values have to be read.

Normals face the camera and have length 1; the plane that a normal stands on says how depth goes on
to the next pixel; positions lie on their pixels' rays; depth is positive. Readings that could be
meant are tried by the same figures. One that fits where the stated one doesn't, and alone, is taken
and said; what fits none is an error, and what is only unlikely a warning.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.errors import ContradictionError
from deepshade.gbuffer.background import DEPTHS, SURFACE
from deepshade.gbuffer.conventions import NORMALS, Conventions, Reading
from deepshade.gbuffer.examination import FEW, MIN_PAIRS, MOST, Examination, Verdict
from deepshade.gbuffer.pairs import CENTRES, Pairs
from deepshade.gbuffer.projecting import check_positions
from deepshade.gbuffer.surfaces import check_surfaces

Array = NDArray[np.floating[Any]]

_LENGTH = 0.1  # by how much a normal may be too short or too long, in the median


def examine(
    arrays: Mapping[str, NDArray[np.float32]],
    used: Collection[str],
    camera: Camera | None,
    matrix: NDArray[np.float64] | None,
    conventions: Conventions,
    *,
    coarse: bool = False,
) -> Verdict:
    """What the stored `arrays` (C, H, W) say about themselves; background is still in them.

    `used` are those from which attributes come; others only mark background. `coarse` positions
    have 16 bits. Raises ContradictionError, under "strict" for warnings too.
    """
    verdict = Verdict({name: conventions.reading(name) for name in arrays})
    if conventions.checks != "trust":
        shape, apart = next(iter(arrays.values())).shape[1:], 4 if coarse else 1
        few, many = (Pairs.of(shape, apart=apart, centres=centres) for centres in CENTRES)
        given = arrays, used, camera, matrix, conventions
        with np.errstate(all="ignore"):
            if not _passed(Examination(*given, few, verdict)):
                verdict = Verdict({name: conventions.reading(name) for name in arrays})
                _check(Examination(*given, many, verdict))
        if conventions.checks == "strict" and verdict.warnings:
            raise ContradictionError(
                "; ".join(verdict.warnings), fix="leave out --strict to have it shaded"
            )
    verdict.readings = {
        name: reading for name, reading in verdict.readings.items() if reading != Reading()
    }
    return verdict


def _passed(e: Examination) -> bool:
    """Whether everything is right, by a good margin."""
    try:
        _check(e)
    except ContradictionError:
        return False
    return e.clear and not e.verdict.notes and not e.verdict.warnings


def _check(e: Examination) -> None:
    """Every check; the later ones look at what the earlier ones have put right."""
    if not _something(e):
        return
    for name in DEPTHS:
        if name in e.stored:
            _sign(e, name)
    for name in NORMALS:
        if name in e.used and name in e.stored:
            _length(e, name)
    if "position" in e.stored:
        check_positions(e)
    check_surfaces(e)
    if e.parallel:
        e.warn("the camera is orthographic; shaders learned perspective")


def _something(e: Examination) -> bool:
    """Whether anything is shown. Raises where one attribute shows nothing and another does."""
    pixels = max(1, int(np.count_nonzero(e.inside)))
    share = {
        name: float(np.count_nonzero(shown & e.inside)) / pixels
        for name, shown in e.shown.items()
        if name != "alpha"
    }
    telling = SURFACE & share.keys()
    if not telling or not e.pairs.count:
        return False
    fullest = max(sorted(telling), key=lambda name: share[name])
    if share[fullest] == 0:
        e.warn("nothing is shown: every pixel is background")
        return False
    for name, there in share.items():
        if there == 0 and share[fullest] > FEW:
            finite = np.isfinite(e.stored[name]).any()
            what = "is 0 or infinite" if finite else "isn't finite"
            raise ContradictionError(
                f"'{name}' {what} everywhere, though '{fullest}' shows surfaces in "
                f"{share[fullest]:.0%} of the picture",
                fix=f"check that pass, or name another channel: --map {name}=<layer>",
            )
        broken = ~np.isfinite(e.stored[name]).all(0) & e.shown[fullest] & e.inside
        if name not in DEPTHS and broken.mean() > 0.5:
            e.warn(f"{broken.mean():.0%} of '{name}' isn't finite, and is background")
    return True


def _sign(e: Examination, name: str) -> None:
    stored, shown = e.stored[name][0], e.shown[name]
    if not shown.any() or e.reading(name).kind in ("normalised", "zbuffer", "reversed"):
        return
    negative = float((stored[shown] < 0).mean())
    if negative >= MOST:
        e.read(name, "stored negative; read with the other sign", sign=-1)
    elif negative > FEW:
        e.warn(f"{negative:.0%} of '{name}' is negative, and is background")


def _length(e: Examination, name: str) -> None:
    stored, shown = e.stored[name], e.shown[name] & e.inside
    if e.asked.normals is not None or np.count_nonzero(shown) < MIN_PAIRS:
        return
    vectors = stored[:, shown][:, ::4]
    length = _lengths(vectors)
    off = float(np.abs(length - 1).mean())
    if off <= _LENGTH / 2:
        return
    # encoded ones may be of length 1 in the median: (0, 1, 0) is 1.22, and (-1, 0, 0) .71
    inside = float(vectors.min()) >= -0.01 and float(vectors.max()) <= 1.01
    if inside and float(np.abs(_lengths(2 * vectors - 1) - 1).mean()) < min(_LENGTH, off / 2):
        e.read(name, "stored as n / 2 + 1 / 2; decoded", encoding="encoded")
        return
    usual = float(np.median(length))
    if abs(usual - 1) > _LENGTH:
        e.read(name, f"of length {usual:.3g} in the median; made 1", encoding="scaled")


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.sqrt((vectors.astype(np.float64) ** 2).sum(0)))
