"""What the checks of a G-buffer look at: some of its pixels, and how they are read so far."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.errors import ContradictionError
from deepshade.gbuffer.background import DEPTHS, FAR, SURFACE
from deepshade.gbuffer.conventions import Conventions, Reading
from deepshade.gbuffer.pairs import Pairs

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

MIN_PAIRS = 64  # fewer say nothing
MOST, FEW = 0.9, 0.1


@dataclass(slots=True)
class Verdict:
    """How each quantity is to be read, what of that was found out, and what looks unlikely."""

    readings: dict[str, Reading] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def note(self, name: str, text: str) -> None:
        """Says something of a quantity, behind what was said before."""
        self.notes[name] = f"{self.notes[name]}; {text}" if name in self.notes else text

    def warn(self, text: str, conventions: Conventions) -> None:
        """Says what looks unlikely. Raises ContradictionError where that is an error."""
        self.warnings.append(text)
        if conventions.checks == "strict":
            raise ContradictionError(text, fix="leave out --strict to have it shaded")


class Examination:
    """The `stored` quantities (C, 2, N) at pairs of pixels, where they are `shown`, and what is
    known of the camera; what is found out goes into the `verdict`."""

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
        self.used, self.verdict, self.arrays = used, verdict, arrays
        self.parallel = camera is not None and camera.projection == "orthographic"
        self.around = camera is not None and camera.projection == "latlong"
        self.clear = True  # no other reading fits nearly as well
        self.stored = {name: pairs.cut(array) for name, array in arrays.items()}
        self.shown = {name: _shown(name, values) for name, values in self.stored.items()}
        alpha = self.stored.get("alpha")
        self.inside = np.ones(pairs.shape, np.bool_) if alpha is None else alpha[0] > 0

    def values(self, name: str) -> Array:
        """As they are read so far, (C, 2, N)."""
        slant = None
        if self.camera is not None and self.reading(name).kind == "distance":
            rays = self.rays
            slant = np.sqrt((rays * rays).sum(0))
        return self.reading(name).of(self.stored[name].astype(np.float32), slant)

    def reading(self, name: str) -> Reading:
        """How a quantity is read so far."""
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
        """Says what looks unlikely."""
        self.verdict.warnings.append(text)


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
