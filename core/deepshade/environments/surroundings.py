"""What lights a picture: an environment map, and how it is turned over the picture's world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deepshade.environments.environment import Environment, Up, world_to_map
from deepshade.environments.lobes import diffuse

Float = NDArray[np.float32]

_FACING = 0.25  # the square of a normal's length; background has none


@dataclass(frozen=True, slots=True)
class Surroundings:
    """A map over a world that is `up` up, turned by `degrees` (`world_to_map`)."""

    environment: Environment
    degrees: float = 0.0
    up: Up = "y"

    @property
    def mean(self) -> Float:
        """(3,): the mean over all directions."""
        return self.environment.mean.astype(np.float32)

    def irradiance(self, normals: Float) -> Float:
        """(3, H, W): what falls on unblocked surfaces of world-space `normals` (3, H, W), over π.

        The map's mean where there is no normal.
        """
        turn = world_to_map(self.degrees, self.up)
        found = diffuse(self.environment).sample(normals, turn)
        facing = (normals * normals).sum(0) > _FACING
        return np.where(facing, found, self.mean[:, None, None])
