"""Environment maps: read, sampled, made, and prepared for shading.

Orientation, and what lies between pixels: `environment`.
"""

from deepshade.environments.environment import (
    LIMITS,
    SUFFIXES,
    Environment,
    Up,
    directions,
    read_environment,
    solid_angles,
    world_to_map,
)
from deepshade.environments.inputs import INPUTS, Prepared, black
from deepshade.environments.sky import sky
from deepshade.environments.surroundings import Surroundings

__all__ = [
    "INPUTS",
    "LIMITS",
    "SUFFIXES",
    "Environment",
    "Prepared",
    "Surroundings",
    "Up",
    "black",
    "directions",
    "read_environment",
    "sky",
    "solid_angles",
    "world_to_map",
]
