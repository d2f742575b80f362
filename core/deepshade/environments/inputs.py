"""What graphs are given of an environment, beside the picture, by the name of the input."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, Up, world_to_map
from deepshade.environments.lobes import HEIGHT, WIDTH, prefilter

Float = NDArray[np.float32]

# input -> its shape: the same for all maps, so that none is compiled anew for another
INPUTS: dict[str, tuple[int, ...]] = {
    "lobes": (1, 3, HEIGHT, WIDTH),  # `lobes.prefilter`
    "turn": (3, 3),  # `world_to_map`
    "camera": (3, 3),  # the same of camera space
}


@dataclass(frozen=True, slots=True)
class Prepared:
    """An environment with what graphs look up in it, ready to be turned by any angle."""

    environment: Environment
    tables: Mapping[str, Float] = field(repr=False)

    @classmethod
    def of(cls, environment: Environment) -> Prepared:
        """Prepare a map; takes about a second."""
        return cls(environment, {"lobes": prefilter(environment)[None]})

    @property
    def bytes(self) -> int:
        """What it holds in memory."""
        tables = sum(table.nbytes for table in self.tables.values())
        return tables + self.environment.radiance.nbytes

    def inputs(
        self,
        names: Collection[str],
        degrees: float,
        up: Up,
        camera: Callable[[], NDArray[np.floating]] | None = None,
    ) -> dict[str, Float]:
        """The inputs of those names, for a world that is `up` up and a map turned by `degrees`.

        `camera` gives the (3, 3) that turns camera space into the world (`camera.camera_to_world`),
        and is called if a name needs it; KeyError where it is missing then.
        """
        turns = {"turn": world_to_map(degrees, up)}
        if camera is not None and "camera" in names:
            turns["camera"] = turns["turn"] @ camera()
        known = {**self.tables, **{name: each.astype(np.float32) for name, each in turns.items()}}
        return {name: known[name] for name in names}


def black(names: Iterable[str]) -> dict[str, Float]:
    """Inputs of these names without any light: what networks are timed with."""
    return {name: np.zeros(INPUTS[name], np.float32) for name in names}
