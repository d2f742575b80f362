"""What a report compares: a way to shade a view, and the view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade.errors import DataError

Float = NDArray[np.float32]


@dataclass(frozen=True)
class View:
    """One picture's attributes and its reference.

    `normal` and `position` are (3, H, W), camera space, scene units; `background` is (H, W), and
    both attributes are zero where it is true. `radius` is the effect's, in scene units; `fov` the
    full horizontal angle of the frame that the view shows or is a window of, in degrees.
    `reference` is (H, W) in [0, 1], 1 = open. `pixels_per_unit` are the pixels that a length of 1
    spans at distance 1, and `axis` is the pixel (column, row) that the optical axis meets, both
    as the frame's width and the window's place give them: None means that the view is the frame.
    `record` is what the data set's manifest keeps to render the sample again (scene, camera).
    """

    scene: str
    normal: Float
    position: Float
    background: NDArray[np.bool_]
    radius: float
    fov: float
    reference: Float
    pixels_per_unit: float | None = None
    axis: tuple[float, float] | None = None
    record: Mapping[str, Any] = field(default_factory=dict)

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.background.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.background.shape[1])

    def pixel_scale(self) -> float:
        """Pixels that a horizontal length of 1 at distance 1 spans."""
        if self.pixels_per_unit is not None:
            return self.pixels_per_unit
        return Camera(self.fov, self.width, self.height).pixels_per_unit

    def optical_axis(self) -> tuple[float, float]:
        """Column and row, in pixels from the top left corner, where the optical axis lies."""
        return (self.width / 2, self.height / 2) if self.axis is None else self.axis

    def camera(self) -> Camera:
        """The camera that the view was rendered with, with its place in the world.

        Raises DataError when the view's record holds none.
        """
        try:
            known = self.record["camera"]
            (width, height), (x0, y0) = known["frame"], known["origin"]
            return Camera(known["fov"], width, height, known["world_to_camera"], x0, y0)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"the view of {self.scene} has no camera: {error}",
                fix="use a data set that 'deepshade datagen' wrote",
            ) from error


class Method(Protocol):
    """A way to compute an effect from a view.

    `family` groups methods in plots; `settings` are what tells this one from others of its name.
    `prepare` does what isn't part of shading a frame (load, compile, open the scene) and keeps
    the view; `shade` computes the prepared view's (H, W) image, values as the reference has them,
    and is what gets timed.
    """

    name: str
    family: str
    settings: dict[str, Any]

    def prepare(self, view: View) -> None:
        """Make ready to shade `view`. Raises DeepshadeError where that can't be."""

    def shade(self, view: View) -> Float:
        """(H, W) of `view`, which was prepared last."""
        ...
