"""A view of a scene, and the images that are made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.effects import SETTINGS

if TYPE_CHECKING:
    from deepshade_workers.environments import EnvironmentLight
    from deepshade_workers.look import Look

# A view's ambient occlusion varies by at least as much (standard deviation), or it shows nothing.
MIN_CONTRAST = 0.06

Vector = tuple[float, float, float]
Image = NDArray[np.float32]  # planar: (C, H, W)
Images = dict[str, Image]


@dataclass(frozen=True)
class Light:
    """What lights a view in place of the scene's own lights: a lamp and a sky.

    The lamp is a sphere of `size` (its radius, scene units; 0 is a point) at `position` (world
    space). `intensity` is its radiant intensity (RGB): a surface that faces it at the distance r
    receives the irradiance intensity / r². The sky's radiance (RGB) turns from `zenith` above over
    `horizon` to `ground` below.
    """

    position: Vector
    size: float
    intensity: Vector
    zenith: Vector
    horizon: Vector
    ground: Vector


@dataclass(frozen=True)
class Limits:
    """How much `drawing.dress` may draw for a view, in pixels.

    The largest diameter of blur circles (of all but one pixel in twenty), the largest motion and
    scattering mean free path, and the folder of the pictures that textures are taken from.
    """

    max_blur: float = 48.0
    max_motion: float = 64.0
    max_scatter: float = 64.0
    textures: str | None = None


@dataclass(frozen=True)
class LookRecord:
    """What a look is drawn from (`look.Look`): the same record, the same look.

    `length` (scene units) is what textures are sized by, `textures` a folder of pictures that are
    used beside the generated ones. `scatter` holds mean free paths (RGB, scene units) by the names
    of the objects that scatter. With `own` all else is the scene's own.
    """

    seed: int
    length: float
    textures: str | None = None
    scatter: Mapping[str, Vector] = field(default_factory=dict)
    own: bool = False


@dataclass(frozen=True)
class View:
    """A camera with the settings of what is seen through it; None where they aren't set.

    `radius`, `focus` (distance) and `aperture` (diameter) are in scene units, `shutter` in frames.
    `displacements` says by name how far objects of the scene move
    while the shutter is open, (x, y, z) in world space; the picture is of the middle of that time.
    Without a `light` the scene's own lights, or its default ones, count; without a `look` its own
    materials. `surroundings` are the environment of effects that have one, which no other light
    comes from.
    """

    camera: Camera
    radius: float
    focus: float | None = None
    aperture: float | None = None
    shutter: float | None = None
    displacements: Mapping[str, Vector] = field(default_factory=dict)
    light: Light | None = None
    look: Look | None = field(default=None, compare=False)
    surroundings: EnvironmentLight | None = field(default=None, compare=False)

    @property
    def environment(self) -> str | None:
        """The name of the environment map."""
        return None if self.surroundings is None else self.surroundings.environment.name

    def settings(self) -> dict[str, float | str]:
        """The settings that are set, by their names in `deepshade.effects.SETTINGS`."""
        names = (name for name, setting in SETTINGS.items() if not setting.of)
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    def header(self) -> dict[str, Any]:
        """The EXR attributes of the camera and the settings."""
        header = {SETTINGS[name].header: value for name, value in self.settings().items()}
        if self.surroundings is not None:
            header["deepshade:rotate"] = self.surroundings.rotation
            header["deepshade:environment_sha256"] = self.surroundings.environment.sha256
        return {**self.camera.to_header(), **header}
