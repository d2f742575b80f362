"""A G-buffer checked against itself: a grid of its pixels tells how its values have to be read.

Normals face the camera and have length 1; the plane that a normal stands on says how depth goes on
to the next pixel; positions lie on their pixels' rays; depth is positive. Readings that could be
meant are tried by the same figures. One that fits where the stated one doesn't, and alone, is taken
and said; what fits none is an error, and what is only unlikely a warning.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera, rotation_of
from deepshade.errors import ContradictionError
from deepshade.gbuffer.axes import AS_STORED, EVERY, Axes
from deepshade.gbuffer.background import DEPTHS, FAR, SURFACE
from deepshade.gbuffer.conventions import NORMALS, Conventions, Reading
from deepshade.gbuffer.depths import MEANINGS, Kind
from deepshade.gbuffer.pairs import CENTRES, Pairs, misfits, projection, slopes_between

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

MIN_PAIRS = 64  # fewer say nothing
_ALIKE = 0.04  # misfits that differ by less say nothing: wrong readings differ by .06 and more
_GOOD = _ALIKE  # misfit that no other reading can be so much better than
_UNLIKELY = 0.6  # misfit of surfaces and normals that have little to do with each other
_LENGTH = 0.1  # by how much a normal may be too short or too long, in the median
_MOST, _FEW = 0.9, 0.1
_SEEN = 0.7  # share of normals that face the camera where they are interpolated, or bumpy


@dataclass(slots=True)
class Verdict:
    """How each quantity is to be read, what of that was found out, and what looks unlikely."""

    readings: dict[str, Reading] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def note(self, name: str, text: str) -> None:
        """Says something of a quantity, behind what was said before."""
        self.notes[name] = f"{self.notes[name]}; {text}" if name in self.notes else text


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
            if not _Examination(*given, few, verdict).passed():
                verdict = Verdict({name: conventions.reading(name) for name in arrays})
                _Examination(*given, many, verdict).all()
        if conventions.checks == "strict" and verdict.warnings:
            raise ContradictionError(
                "; ".join(verdict.warnings), fix="leave out --strict to have it shaded"
            )
    verdict.readings = {
        name: reading for name, reading in verdict.readings.items() if reading != Reading()
    }
    return verdict


class _Examination:
    def __init__(
        self,
        arrays: Mapping[str, NDArray[np.float32]],
        used: Collection[str],
        camera: Camera | None,
        matrix: NDArray[np.float64] | None,
        asked: Conventions,
        pairs: Pairs,
        verdict: Verdict,
    ) -> None:
        self.camera, self.matrix, self.asked, self.pairs = camera, matrix, asked, pairs
        self.used, self.verdict = used, verdict
        self.clear = True  # no other reading fits nearly as well
        self.stored = {name: pairs.cut(array) for name, array in arrays.items()}
        self.shown = {name: _shown(name, values) for name, values in self.stored.items()}
        alpha = self.stored.get("alpha")
        self.inside = np.ones(pairs.shape, np.bool_) if alpha is None else alpha[0] > 0

    def passed(self) -> bool:
        """Whether everything is right, by a good margin."""
        try:
            self.all()
        except ContradictionError:
            return False
        return self.clear and not self.verdict.notes and not self.verdict.warnings

    def all(self) -> None:
        """Every check; the later ones look at what the earlier ones have put right."""
        if not self._something():
            return
        for name in DEPTHS:
            if name in self.stored:
                self._sign(name)
        for name in NORMALS:
            if name in self.used and name in self.stored:
                self._length(name)
        if "position" in self.stored:
            self._pixels()
        self._surfaces()

    def values(self, name: str) -> Array:
        """As they are read so far, (C, 2, N)."""
        slant = None
        if self.camera is not None and self.reading(name).kind == "distance":
            rays = self.rays
            slant = np.sqrt((rays * rays).sum(0))
        return self.reading(name).of(self.stored[name].astype(np.float32), slant)

    def reading(self, name: str) -> Reading:
        return self.verdict.readings[name]

    @property
    def rays(self) -> Array:
        """The camera's, (3, 2, N)."""
        assert self.camera is not None
        return self.camera.rays_at(self.pairs.columns, self.pairs.rows)

    def read(self, name: str, note: str, **changed: Any) -> None:
        """Read `name` so from now on, and say it."""
        self.verdict.readings[name] = replace(self.reading(name), **changed)
        self.verdict.note(name, note)

    def warn(self, text: str) -> None:
        self.verdict.warnings.append(text)

    def _something(self) -> bool:
        """Whether anything is shown. Raises where one attribute shows nothing and another does."""
        pixels = max(1, int(np.count_nonzero(self.inside)))
        share = {
            name: float(np.count_nonzero(shown & self.inside)) / pixels
            for name, shown in self.shown.items()
            if name != "alpha"
        }
        telling = SURFACE & share.keys()
        if not telling or not self.pairs.count:
            return False
        fullest = max(sorted(telling), key=lambda name: share[name])
        if share[fullest] == 0:
            self.warn("nothing is shown: every pixel is background")
            return False
        for name, there in share.items():
            if there == 0 and share[fullest] > _FEW:
                finite = np.isfinite(self.stored[name]).any()
                what = "is 0 or infinite" if finite else "isn't finite"
                raise ContradictionError(
                    f"'{name}' {what} everywhere, though '{fullest}' shows surfaces in "
                    f"{share[fullest]:.0%} of the picture",
                    fix=f"check that pass, or name another channel: --map {name}=<layer>",
                )
            broken = ~np.isfinite(self.stored[name]).all(0) & self.shown[fullest] & self.inside
            if name not in DEPTHS and broken.mean() > 0.5:
                self.warn(f"{broken.mean():.0%} of '{name}' isn't finite, and is background")
        return True

    def _sign(self, name: str) -> None:
        stored, shown = self.stored[name][0], self.shown[name]
        if not shown.any() or self.reading(name).kind in ("normalised", "zbuffer", "reversed"):
            return
        negative = float((stored[shown] < 0).mean())
        if negative >= _MOST:
            self.read(name, "stored negative; read with the other sign", sign=-1)
        elif negative > _FEW:
            self.warn(f"{negative:.0%} of '{name}' is negative, and is background")

    def _length(self, name: str) -> None:
        stored, shown = self.stored[name], self.shown[name] & self.inside
        if self.asked.normals is not None or np.count_nonzero(shown) < MIN_PAIRS:
            return
        vectors = stored[:, shown][:, ::4]
        length = _lengths(vectors)
        off = float(np.abs(length - 1).mean())
        if off <= _LENGTH / 2:
            return
        # encoded ones may be of length 1 in the median: (0, 1, 0) is 1.22, and (-1, 0, 0) .71
        inside = float(vectors.min()) >= -0.01 and float(vectors.max()) <= 1.01
        if inside and float(np.abs(_lengths(2 * vectors - 1) - 1).mean()) < min(_LENGTH, off / 2):
            self.read(name, "stored as n / 2 + 1 / 2; decoded", encoding="encoded")
            return
        usual = float(np.median(length))
        if abs(usual - 1) > _LENGTH:
            self.read(name, f"of length {usual:.3g} in the median; made 1", encoding="scaled")

    def _pixels(self) -> None:
        """Positions lie on the rays of their pixels: which axes make them do so?"""
        stored, shown = self.stored["position"], self.shown["position"] & self.inside
        if np.count_nonzero(shown) < MIN_PAIRS or self.pairs.thin:
            return
        shown = shown.copy()
        shown[1] &= self.pairs.count < 4 * MIN_PAIRS  # neighbours say the same
        columns, rows = self.pairs.columns[shown], self.pairs.rows[shown]
        asked = self.asked.axes.get("position")
        points = stored[:, shown]
        found = projection((asked or AS_STORED).of(points), columns, rows)
        if found is not None:
            self._field_of_view(found[0][0])
            return
        fitting = [axes for axes in EVERY if projection(axes.of(points), columns, rows)]
        if len(fitting) == 1 and asked is None:
            axes = fitting[0]
            self.read("position", f"stored with other axes; read as {axes}{axes.name}", axes=axes)
            return
        seen = "the positions don't lie on the rays of their pixels, as a camera at 0 sees them"
        if fitting:
            options = [f"--axes position:{axes}" for axes in fitting]
            raise ContradictionError(
                f"{seen}; with the axes {fitting[0]}{fitting[0].name} they would",
                seen=seen,
                fits=[str(axes) for axes in fitting],
                fix=" or ".join(options),
            )
        world = None
        if self.matrix is not None:
            placed = self.matrix[:3, :3] @ points + self.matrix[:3, 3:]
            world = projection(placed, columns, rows)
        if world:
            raise ContradictionError(
                f"{seen}; in world space they would",
                seen=seen,
                fits=["world space"],
                fix="--map position_world=position",
            )
        if projection(points, columns, rows, parallel=True):
            self.warn(
                "the positions are those of an orthographic camera; shaders learned perspective"
            )
            return
        side = float((stored[2, shown] > 0).mean())
        raise ContradictionError(
            f"{seen}: {side:.0%} lie behind it" if side > _FEW else seen,
            seen=seen,
            fix="if they are in world space, say so and where the camera is: "
            "--map position_world=<layer> and --world-to-camera <16 numbers>",
        )

    def _field_of_view(self, pixel: float) -> None:
        """Whether the camera's field of view is the one that the positions imply."""
        if self.camera is None:
            return
        wide = pixel * self.camera.pixels_per_unit  # how much wider they are
        if not 0.9 < wide < 1.1:
            half = np.degrees(np.arctan(0.5 * self.camera.width * pixel))
            self.warn(
                f"the positions span {2 * half:.3g}° across the frame, but the field of view is "
                f"{self.camera.fov:.3g}°"
            )

    def _surfaces(self) -> None:
        """Normals and the depths of neighbouring pixels: which readings go together?"""
        place = self._places()
        if place is None:
            return
        source, kinds = place
        for name in NORMALS:
            if name in self.used and name in self.stored:
                if name == "normal_world" and self.matrix is None:
                    continue
                if not self._together(name, source, kinds):
                    return

    def _places(self) -> tuple[str, Sequence[Kind]] | None:
        """The quantity that says where surfaces are, and how it may be read."""
        if "position" in self.stored:
            return "position", ("planar",)
        if "position_world" in self.stored and self.matrix is not None:
            return "position_world", ("planar",)
        if self.camera is None:
            return None
        if "depth" in self.stored:
            if self.asked.depth is not None:
                return "depth", (self.asked.depth,)
            return "depth", ("planar", "distance", "inverse")
        return ("distance", ("planar",)) if "distance" in self.stored else None

    def _seen(self, source: str, kind: Kind) -> tuple[Array, Array]:
        """(planar depths (2, N), rays (3, 2, N) with z = -1) where `source` says surfaces are."""
        if source in ("position", "position_world"):
            points = self.values(source).astype(np.float64)
            if source == "position_world":
                assert self.matrix is not None
                points = np.tensordot(self.matrix[:3, :3], points, 1)
                points += self.matrix[:3, 3, None, None]
            return -points[2], points / -points[2]
        rays = self.rays
        slant = np.sqrt((rays * rays).sum(0))
        if source == "distance":
            return self.values(source)[0] / slant, rays
        reading = replace(self.reading(source), kind=kind)
        return reading.of(self.stored[source].astype(np.float32), slant)[0], rays

    def _together(self, name: str, source: str, kinds: Sequence[Kind]) -> bool:
        """Checks the normals `name` against the surfaces; whether they could be compared."""
        there = self.shown[name] & self.shown[source] & self.inside
        both = there.all(0)
        if np.count_nonzero(both) < MIN_PAIRS:
            return False
        reading = self.reading(name)
        normals = replace(reading, axes=AS_STORED).of(self.stored[name].astype(np.float32))
        normals = normals[:, :, both]
        places = {kind: self._seen(source, kind) for kind in kinds}
        rays = places[kinds[0]][1][:, :, both]
        slopes = {kind: slopes_between(at[:, both], rays) for kind, (at, _) in places.items()}
        if name == "normal_world" and self.matrix is not None:  # the rays into their space
            rays = np.tensordot(rotation_of(self.matrix).T, rays, 1)
        (stated,), (facing,) = misfits(normals, rays, slopes[kinds[0]], (reading.axes,))
        if stated < _GOOD and facing > _MOST:
            return True
        every = (reading.axes,) if name in self.asked.axes else EVERY
        tried = [
            (float(off), axes, kind)
            for kind, change in slopes.items()
            for off, faces, axes in zip(*misfits(normals, rays, change, every), every, strict=True)
            if faces > _MOST and (axes, kind) != (reading.axes, kinds[0])
        ]
        tried.sort(key=lambda each: each[0])
        least = tried[0][0] if tried else 1.0
        self.clear &= bool(stated < least - _ALIKE)
        if facing > _SEEN and stated < least + _ALIKE:
            if stated > _UNLIKELY:
                self.warn(f"'{name}' hardly fits the surfaces that '{source}' shows")
            return True
        equals = [each for each in tried if each[0] < least + _ALIKE / 2]
        if least > _UNLIKELY:
            equals = []
        self._settle(name, source, float(facing), kinds[0], equals, normals)
        return True

    def _settle(
        self,
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
            if facing < _MOST
            else (f"'{name}' and '{source}' contradict each other")
        )
        if not equals:
            raise ContradictionError(
                f"{seen}, and with no axes does it fit the surfaces that '{source}' shows",
                seen=seen,
                fix=f"if it is of world space: --map normal_world=<layer>; to have it calculated "
                f"from '{source}': --derive {name}",
            )
        _, axes, best = equals[0]
        alike = [
            each
            for each in equals
            if each[2] != best or np.abs(each[1].of(normals) - axes.of(normals)).mean() > 0.05
        ]
        if alike:
            options = [
                " and ".join(_option(name, other, source, which, kind, self.reading(name).axes))
                for _, other, which in [equals[0], *alike[:2]]
            ]
            raise ContradictionError(
                f"{seen}, and more than one reading fits",
                seen=seen,
                fits=options,
                fix=", or ".join(options),
            )
        if axes != self.reading(name).axes:
            self.read(name, f"stored with other axes; read as {axes}{axes.name}", axes=axes)
        if best != kind:
            self.read(source, f"stored as {MEANINGS[best]}, as the normals show", kind=best)


def _option(
    name: str, axes: Axes, source: str, kind: Kind, stated: Kind, before: Axes
) -> list[str]:
    """What to ask for to have it read so."""
    return [f"--axes {name}:{axes}"] * (axes != before) + [f"--depth {kind}"] * (kind != stated)


def _shown(name: str, stored: Array) -> Mask:
    """(2, N): where a quantity shows a surface, whatever the sign of depth."""
    if name == "alpha":
        return np.asarray(stored[0] > 0)
    finite = np.isfinite(stored).all(0)
    if name in DEPTHS:
        return np.asarray(finite & (stored[0] != 0) & (np.abs(stored[0]) < FAR))
    if name == "position":
        return np.asarray(finite & (stored[2] != 0) & (np.abs(stored[2]) < FAR))
    if name not in SURFACE:  # black, at rest and in focus are 0 too
        return np.asarray(finite)
    return np.asarray(finite & (stored != 0).any(0))


def _lengths(vectors: Array) -> Array:
    return np.asarray(np.sqrt((vectors.astype(np.float64) ** 2).sum(0)))
