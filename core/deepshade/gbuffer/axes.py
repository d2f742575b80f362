"""Axes and signs of stored vectors, as `x,-y,-z`, with names for the common ones."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.errors import ConfigError

# Our camera space, x right, y up, z towards the viewer, from that of others: graphics and
# mathematics, computer vision (y down, z into the picture), a left-handed camera's, and Unreal's
# (x into the picture, y right, z up).
NAMED = {
    "opengl": "x,y,z",
    "opencv": "x,-y,-z",
    "directx": "x,y,-z",
    "unity": "x,y,-z",
    "unreal": "y,z,-x",
}
_LETTERS = "xyz"


@dataclass(frozen=True, slots=True)
class Axes:
    """Our x, y and z from stored components: `order` are their numbers, `signs` are 1 or -1."""

    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)

    @classmethod
    def parse(cls, text: str) -> Axes:
        """Of `x,-y,-z` or a name (`NAMED`). Raises ConfigError for anything else."""
        words = NAMED.get(text.strip().lower(), text).replace(" ", "").lower().split(",")
        found = [re.fullmatch(r"([+-]?)([xyz])", word) for word in words]
        matches = [match for match in found if match]
        letters = [match[2] for match in matches]
        if len(found) != 3 or len(set(letters)) != 3:
            raise ConfigError(
                text, NAMED, detail=f"'{text:.60}' are no axes: write for example x,-y,-z"
            )
        a, b, c = (_LETTERS.index(letter) for letter in letters)
        i, j, k = (-1 if match[1] == "-" else 1 for match in matches)
        return cls((a, b, c), (i, j, k))

    def __str__(self) -> str:
        return ",".join(
            ("-" if sign < 0 else "") + _LETTERS[axis]
            for axis, sign in zip(self.order, self.signs, strict=True)
        )

    @property
    def name(self) -> str:
        """The first of the common names, in brackets behind a blank; "" where there is none."""
        return next((f" ({name})" for name, axes in NAMED.items() if axes == str(self)), "")

    def of(self, vectors: NDArray[Any]) -> NDArray[Any]:
        """Stored vectors (3, ...) in our axes."""
        signs = np.array(self.signs, vectors.dtype).reshape(3, *(1,) * (vectors.ndim - 1))
        turned: NDArray[Any] = vectors[list(self.order)] * signs
        return turned


AS_STORED = Axes()
# The named ones first: of equals they are the likelier.
EVERY = tuple(
    dict.fromkeys(
        [Axes.parse(name) for name in NAMED]
        + [
            Axes((a, b, c), signs)  # type: ignore[arg-type]
            for a, b, c in itertools.permutations(range(3))
            for signs in itertools.product((1, -1), repeat=3)
        ]
    )
)
