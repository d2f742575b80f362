"""A G-buffer as a case makes it: values, header and parameters, and what must come out."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.attributes import ATTRIBUTES, LENGTH, POINT, Attribute
from deepshade.camera import Camera
from deepshade.effects import SETTINGS
from deepshade.environments import Environment, Surroundings
from deepshade_report.view import View

Float = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Settings in the header that are lengths, as attributes of these units are.
LENGTHS = ("radius", "focus", "aperture")
UNITS = (LENGTH, POINT)


@dataclass(frozen=True, eq=False)
class Picture:
    """What is sent, and what is expected.

    `planes` are (C, H, W) by attribute, or by the name of another quantity that one is derived
    from; those `half` are stored in 16 bits. `header` holds settings by name, `asked` are
    parameters of the request. `truth` is (C', H, W): the path tracer's answer, or where `closed`
    one that follows by hand. Without it the float64 answer counts, to this picture or to `like`.
    Pixels outside `compared` don't count. Light is exposed by `white`, else as the truth is.
    `tiles` bounds a tile's pixels. With `refused` the right answer is an error.
    """

    planes: Mapping[str, Float]
    camera: Camera
    header: Mapping[str, Any] = field(default_factory=dict)
    asked: Mapping[str, Any] = field(default_factory=dict)
    surroundings: Surroundings | None = None
    truth: Float | None = None
    closed: bool = False
    like: Picture | None = None
    compared: Mask | None = None
    white: float | None = None
    half: frozenset[str] = frozenset()
    tiles: int | None = None
    refused: bool = False

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = next(iter(self.planes.values())).shape[1:]
        return height, width

    def put(self, **planes: Float) -> Picture:
        """With these planes in place of its own."""
        return replace(self, planes={**self.planes, **planes})

    def ask(self, **asked: Any) -> Picture:
        """With these parameters."""
        return replace(self, asked={**self.asked, **asked})

    def say(self, **header: Any) -> Picture:
        """With these settings in the header."""
        return replace(self, header={**self.header, **header})

    def scaled(self, factor: float) -> Picture:
        """The same scene, all its lengths times `factor`."""
        planes = {
            name: plane * np.float32(factor) if unit_is_length(name) else plane
            for name, plane in self.planes.items()
        }
        header = {n: v * factor if n in LENGTHS else v for n, v in self.header.items()}
        matrix = self.camera.matrix.copy()
        matrix[:3, 3] *= factor
        camera = replace(self.camera, world_to_camera=matrix)
        return replace(self, planes=planes, header=header, camera=camera)

    def cut(self, rows: slice, columns: slice) -> Picture:
        """A window of it; the camera stays that of the whole frame."""
        camera = replace(
            self.camera,
            x0=self.camera.x0 + (columns.start or 0),
            y0=self.camera.y0 + (rows.start or 0),
        )
        planes = {
            name: np.ascontiguousarray(plane[:, rows, columns])
            for name, plane in self.planes.items()
        }
        truth = None if self.truth is None else np.ascontiguousarray(self.truth[:, rows, columns])
        return replace(self, planes=planes, truth=truth, camera=camera)

    def body(self) -> bytes:
        """The EXR file."""
        channels: dict[str, Float] = {}
        narrow: set[str] = set()
        for name, planes in self.planes.items():
            names = channels_of(name)
            channels |= dict(zip(names, planes, strict=True))
            narrow |= set(names) if name in self.half else set()
        height, width = self.shape
        x, y = self.camera.x0, self.camera.y0
        header: dict[str, Any] = {
            SETTINGS[name].header: float(value) for name, value in self.header.items()
        }
        header |= {
            "deepshade:fov": self.camera.fov,
            "worldToCamera": self.camera.matrix.T.astype(np.float32),
        }
        stream = io.BytesIO()
        with np.errstate(over="ignore"):  # of 16 bits: a case of its own
            exr.write(
                stream,
                channels,
                attributes=header,
                half=narrow,
                compression="none",
                data_window=(x, y, x + width - 1, y + height - 1),
                display_window=(0, 0, self.camera.width - 1, self.camera.height - 1),
            )
        return stream.getvalue()


def of_view(view: View, height: int, width: int) -> Picture:
    """The middle of a view. Blur circles follow from depth and the lens, where that is known."""
    settings = {
        name: float(view.record[name])
        for name in view.effect.settings
        if SETTINGS[name].stored and name in view.record
    }
    planes = {name: np.asarray(view.attributes[name]) for name in view.effect.inputs}
    top, left = (view.height - height) // 2, (view.width - width) // 2
    whole = Picture(
        planes, view.camera, settings, surroundings=view.surroundings, truth=view.reference
    )
    return whole.cut(slice(top, top + height), slice(left, left + width))


def unit_is_length(name: str) -> bool:
    """Whether a quantity is measured in scene units."""
    return name == "position_world" or (name in ATTRIBUTES and ATTRIBUTES[name].unit in UNITS)


def channels_of(name: str) -> tuple[str, ...]:
    """A quantity's channels in a file."""
    known: Attribute | None = ATTRIBUTES.get(name)
    return known.channels if known else tuple(f"{name}.{axis}" for axis in "XYZ")


def white_world() -> Surroundings:
    """An environment of radiance 1 from everywhere."""
    return Surroundings(Environment("white", np.ones((3, 32, 64), np.float32)))
