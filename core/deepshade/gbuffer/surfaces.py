"""Whether normals and the depths of neighbouring pixels go together, and as which readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import rotation_of
from deepshade.errors import ContradictionError
from deepshade.gbuffer.axes import AS_STORED, EVERY, Axes
from deepshade.gbuffer.conventions import NORMALS, Reading
from deepshade.gbuffer.depths import MEANINGS, Kind
from deepshade.gbuffer.examination import MIN_PAIRS, MOST, Examination
from deepshade.gbuffer.guesses import fitting_lens
from deepshade.gbuffer.pairs import misfits, parallel, slopes_between

Array = NDArray[np.floating[Any]]

_ALIKE = 0.04  # misfits that differ by less say nothing: wrong readings differ by .06 and more
_GOOD = _ALIKE  # misfit that no other reading can be so much better than
_UNLIKELY = 0.6  # misfit of surfaces and normals that have little to do with each other
_SEEN = 0.7  # share of normals that face the camera where they are interpolated, or bumpy


def check_surfaces(e: Examination) -> None:
    """Normals and the depths of neighbouring pixels: which readings go together?"""
    place = _places(e)
    if place is None:
        return
    source, kinds = place
    for name in NORMALS:
        if name in e.used and name in e.stored:
            if name == "normal_object" or (name == "normal_world" and e.matrix is None):
                continue  # nobody knows how it is turned to the camera
            if not _together(e, name, source, kinds):
                return


def _places(e: Examination) -> tuple[str, Sequence[Kind]] | None:
    """The quantity that says where surfaces are, and how it may be read."""
    if "position" in e.stored:
        return "position", ("planar",)
    if "position_world" in e.stored and e.matrix is not None:
        return "position_world", ("planar",)
    if e.camera is None:
        return None
    if "depth" in e.stored:
        if e.asked.depth is not None:
            return "depth", (e.asked.depth,)
        if e.camera.projection != "perspective":
            return "depth", ("planar",)
        return "depth", ("planar", "distance", "inverse")
    return ("distance", ("planar",)) if "distance" in e.stored else None


def _seen(e: Examination, source: str, kind: Kind) -> tuple[Array, Array]:
    """(depths (2, N), rays (3, 2, N)) whose product is where `source` says surfaces are."""
    if source in ("position", "position_world"):
        points = e.values(source).astype(np.float64)
        if source == "position_world":
            assert e.matrix is not None
            points = np.tensordot(e.matrix[:3, :3], points, 1)
            points += e.matrix[:3, 3, None, None]
        if e.parallel:
            reach = 100 * float(np.nanmedian(np.abs(points[:, e.shown[source]])))
            return parallel(points, reach)
        if e.around:
            distance = np.sqrt((points * points).sum(0))
            return distance, points / distance
        return -points[2], points / -points[2]
    rays = e.rays
    slant = np.sqrt((rays * rays).sum(0))
    if e.camera is not None and e.camera.projection == "orthographic":
        depth = e.values(source)[0].astype(np.float64)
        points = e.camera.points_at(e.pairs.columns, e.pairs.rows, depth)
        return parallel(points, 100 * e.camera.across)
    if source == "distance":
        return e.values(source)[0] / slant, rays
    reading = replace(e.reading(source), kind=kind)
    return reading.of(e.stored[source].astype(np.float32), slant)[0], rays


def _together(e: Examination, name: str, source: str, kinds: Sequence[Kind]) -> bool:
    """Checks the normals `name` against the surfaces; whether they could be compared."""
    there = e.shown[name] & e.shown[source] & e.inside
    both = there.all(0)
    if np.count_nonzero(both) < MIN_PAIRS:
        return False
    reading = e.reading(name)
    normals = replace(reading, axes=AS_STORED).of(e.stored[name].astype(np.float32))
    normals = normals[:, :, both]
    places = {kind: _seen(e, source, kind) for kind in kinds}
    rays = places[kinds[0]][1][:, :, both]
    slopes = {kind: slopes_between(at[:, both], rays) for kind, (at, _) in places.items()}
    if name == "normal_world" and e.matrix is not None:  # the rays into their space
        rays = np.tensordot(rotation_of(e.matrix).T, rays, 1)
    (stated,), (facing,) = misfits(normals, rays, slopes[kinds[0]], (reading.axes,))
    if stated < _GOOD and facing > MOST:
        return True
    every = (reading.axes,) if name in e.asked.axes else EVERY
    tried = [
        (float(off), axes, kind)
        for kind, change in slopes.items()
        for off, faces, axes in zip(*misfits(normals, rays, change, every), every, strict=True)
        if faces > MOST and (axes, kind) != (reading.axes, kinds[0])
    ]
    tried.sort(key=lambda each: each[0])
    least = tried[0][0] if tried else 1.0
    e.clear &= bool(stated < least - _ALIKE)
    if facing > _SEEN and stated < least + _ALIKE:
        if stated > _UNLIKELY:
            lens, _ = _lens(e, name, source)
            would = f"; with {lens} it would" if lens else ""
            e.warn(f"'{name}' hardly fits the surfaces that '{source}' shows{would}")
        return True
    equals = [each for each in tried if each[0] < least + _ALIKE / 2]
    if least > _UNLIKELY:
        equals = []
    _settle(e, name, source, float(facing), kinds[0], equals, normals)
    return True


def _lens(e: Examination, name: str, source: str) -> tuple[str, float]:
    """The options that ask for a lens with which both would go together, as they are read so far,
    and how little they misfit then; "" for none."""
    readings = {e.reading(name), e.reading(source)}
    if e.camera is None or (name, source) != ("normal", "depth") or readings != {Reading()}:
        return "", 1.0
    return fitting_lens(e.arrays[name], e.arrays[source], e.camera)


def _settle(
    e: Examination,
    name: str,
    source: str,
    facing: float,
    kind: Kind,
    equals: Sequence[tuple[float, Axes, Kind]],
    normals: Array,
) -> None:
    """Takes the reading that fits best if it is the only one; raises otherwise."""
    seen = (
        f"{facing:.0%} of '{name}' faces the camera"
        if facing < MOST
        else (f"'{name}' and '{source}' contradict each other")
    )
    lens, off = _lens(e, name, source)
    # a lens that fits much better than any axes: then it is the lens that is wrong
    if not equals or off < equals[0][0] / 2:
        why = f"{seen}, and with no axes does it fit the surfaces that '{source}' shows"
        if equals:
            why = f"{seen} as this lens sees them"
        raise ContradictionError(
            f"{why}; with another lens it would" if lens else why,
            seen=seen,
            fits=[lens] if lens else [],
            fix=lens
            or f"if it is of world space: --map normal_world=<layer>; to have it calculated from "
            f"'{source}': --derive {name}",
        )
    _, axes, best = equals[0]
    alike = [
        each
        for each in equals
        if each[2] != best or np.abs(each[1].of(normals) - axes.of(normals)).mean() > 0.05
    ]
    if alike:
        options = [
            " ".join(_option(name, other, source, which, kind, e.reading(name).axes))
            for _, other, which in [equals[0], *alike[:2]]
        ]
        raise ContradictionError(
            f"{seen}, and more than one reading fits",
            seen=seen,
            fits=options,
            fix=", or ".join(options),
        )
    if axes != e.reading(name).axes:
        e.read(name, f"stored with other axes; read as {axes}{axes.name}", axes=axes)
    if best != kind:
        e.read(source, f"stored as {MEANINGS[best]}, as the normals show", kind=best)


def _option(
    name: str, axes: Axes, source: str, kind: Kind, stated: Kind, before: Axes
) -> list[str]:
    """What to ask for to have it read so."""
    return [f"--axes {name}:{axes}"] * (axes != before) + [f"--depth {kind}"] * (kind != stated)
