"""How stored values are read as ours: axes, encoding, kind of depth; asked for or found out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.errors import ConfigError
from deepshade.gbuffer.axes import AS_STORED, Axes
from deepshade.gbuffer.depths import KINDS, Kind, check_planes, planar

Encoding = Literal["signed", "encoded", "scaled"]
ENCODINGS: tuple[Encoding, ...] = get_args(Encoding)
Checks = Literal["usual", "strict", "trust"]
VECTORS = ("position", "normal", "position_world", "normal_world")
NORMALS = ("normal", "normal_world", "normal_object")

Float = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a request says of the stored values; what it leaves out is found out.

    `axes` of vectors by quantity; `normals` are "signed" (-1 to 1), "encoded" (n / 2 + 1 / 2) or
    "scaled" (of any length); `depth` is of a kind (`depths.MEANINGS`), with the depths of the
    `near` and the `far` plane where it needs them. `checks`: "strict" makes warnings errors,
    "trust" believes everything. Raises ConfigError for planes that are missing or make no sense.
    """

    axes: Mapping[str, Axes] = field(default_factory=dict)
    normals: Encoding | None = None
    depth: Kind | None = None
    near: float | None = None
    far: float | None = None
    checks: Checks = "usual"

    def __post_init__(self) -> None:
        check_planes(self.depth, self.near, self.far)

    def reading(self, quantity: str) -> Reading:
        """How `quantity` is read where nothing but this is known."""
        kind: Kind = "planar"
        if quantity == "depth" and self.depth is not None:
            kind = self.depth
        return Reading(
            axes=self.axes.get(quantity, AS_STORED),
            encoding=(self.normals or "signed") if quantity in NORMALS else "signed",
            kind=kind,
            near=self.near,
            far=self.far,
        )


@dataclass(frozen=True, slots=True)
class Reading:
    """How the stored values of one quantity are turned into ours."""

    axes: Axes = AS_STORED
    encoding: Encoding = "signed"
    kind: Kind = "planar"
    sign: int = 1
    near: float | None = None
    far: float | None = None

    def of(self, stored: Float, slant: NDArray[np.floating[Any]] | None = None) -> Float:
        """Stored values (C, ...) as ours; the same array where they are already.

        `slant` is as in `depths.planar`.
        """
        values: NDArray[Any] = stored
        if self.encoding == "encoded":
            # what no renderer writes for a surface: nothing, and nothing encoded
            empty = (stored == 0).all(0) | (np.abs(stored - 0.5) < 1 / 128).all(0)
            values = np.where(empty, 0, 2 * stored - 1)
        elif self.encoding == "scaled":
            length = np.sqrt((stored * stored).sum(0))
            values = stored / np.where(length > 0, length, 1)
        if self.axes != AS_STORED:
            values = self.axes.of(values)
        if self.sign < 0:
            values = -values
        if self.kind != "planar":
            values = planar(values, self.kind, slant=slant, near=self.near, far=self.far)
        return values if values is stored else np.ascontiguousarray(values, np.float32)


def parse_axes(entries: Iterable[str]) -> dict[str, Axes]:
    """`["position:x,-y,-z", "normal:opencv"]` by quantity; `["opencv"]` is of both.

    Raises ConfigError.
    """
    found: dict[str, Axes] = {}
    for entry in entries:
        name, colon, text = (piece.strip() for piece in entry.rpartition(":"))
        names = (name,) if colon else ("position", "normal")
        if not set(names) <= set(VECTORS):
            raise ConfigError(name, VECTORS, detail=f"'{name:.60}' is no vector with axes")
        for each in names:
            if each in found:
                raise ConfigError(each, detail=f"the axes of '{each}' are given twice")
            found[each] = Axes.parse(text)
    return found


def parse_conventions(
    axes: Iterable[str],
    normals: str | None,
    depth: str | None,
    near: float | None = None,
    far: float | None = None,
    checks: Checks = "usual",
) -> Conventions:
    """From texts, as commands and requests have them. Raises ConfigError."""
    for name, value, known in (("normals", normals, ENCODINGS), ("depth", depth, KINDS)):
        if value is not None and value not in known:
            raise ConfigError(
                value, known, detail=f"{name} can be {', '.join(known)}, not '{value:.60}'"
            )
    return Conventions(parse_axes(axes), normals, depth, near, far, checks)  # type: ignore[arg-type]


def apply(readings: Mapping[str, Reading], arrays: dict[str, Float], camera: Camera | None) -> None:
    """Turns the `arrays` (C, H, W) that have a reading into ours."""
    for name, reading in readings.items():
        if name not in arrays:
            continue
        slant = None
        if reading.kind == "distance":
            if camera is None:
                continue  # it only marks the background
            slant = camera.slant(*arrays[name].shape[:0:-1])
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            arrays[name] = reading.of(arrays[name], slant)
