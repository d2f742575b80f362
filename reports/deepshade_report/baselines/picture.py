"""Pictures on the device, and the one Method that all screen-space rivals are.

Each is a chain of functions that Dr.Jit compiles; within one, a pixel's whole loop runs in
registers: the nearest that a processor comes to the shaders that these methods were made as. (As
separate tensor operations they took 8 to 12 times as long, and a comparison at the same
milliseconds flattered the networks.) On a machine with a GPU they run there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import drjit as dr
import numpy as np

from deepshade_report.method import SCREEN_SPACE
from deepshade_report.view import Float, View
from deepshade_workers.backend import mitsuba

mi = mitsuba()


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Grid:
    """The size of a picture whose planes are flat, in row-major order."""

    shape: tuple[int, int]
    width: Any
    height: Any

    @staticmethod
    def of(height: int, width: int) -> Grid:
        """The grid of a picture. Its size is no constant of what is compiled for it."""
        return Grid((height, width), dr.opaque(mi.Int32, width), dr.opaque(mi.Int32, height))

    def pixels(self) -> tuple[Any, Any]:
        """Column and row of every pixel."""
        return self.coordinates(dr.arange(mi.Int32, self.shape[0] * self.shape[1]))

    def coordinates(self, index: Any) -> tuple[Any, Any]:
        """Column and row of pixels by their index."""
        row = index // self.width
        return index - row * self.width, row

    def at(self, column: Any, row: Any) -> Any:
        """The index of a pixel, or of the nearest one in the picture."""
        column = dr.clip(column, 0, self.width - 1)
        return mi.UInt32(dr.clip(row, 0, self.height - 1) * self.width + column)

    def place(self, column: Any, row: Any) -> tuple[Any, Any]:
        """The index of a pixel, and whether it lies in the picture."""
        inside = (column >= 0) & (row >= 0) & (column < self.width) & (row < self.height)
        return mi.UInt32(row * self.width + column), inside

    def look(self, plane: Any, column: Any, row: Any) -> tuple[Any, Any]:
        """Any pixel's value of a plane (or of three), and whether it lies in the picture."""
        place, inside = self.place(column, row)
        return dr.gather(type(plane), plane, place, inside), inside


def light(planes: Float) -> Any:
    """(3, H, W) light on the device; what isn't finite is 0."""
    return mi.Color3f(*(plain(plane) for plane in planes))


def plain(plane: Float) -> Any:
    """(H, W) on the device; what isn't finite is 0."""
    values = mi.Float(np.nan_to_num(plane, posinf=0.0, neginf=0.0).astype(np.float32).ravel())
    # A copy: NumPy's own memory may not be aligned, and then kernels differ from view to view.
    values = values * dr.opaque(mi.Float, 1)
    dr.eval(values)
    return values


def number(value: float) -> Any:
    """A number on the device: no constant of what is compiled with it."""
    return dr.opaque(mi.Float, value)


def gradient_noise(column: Any, row: Any) -> Any:
    """Interleaved gradient noise in [0, 1) (Jimenez 2014, "Next Generation Post Processing")."""
    value = 52.9829189 * _fraction(0.06711056 * mi.Float(column) + 0.00583715 * mi.Float(row))
    return _fraction(value)


def _fraction(value: Any) -> Any:
    return value - dr.floor(value)


class Filter:
    """A screen-space Method: `upload` puts a view on the device, `kernel` shades it.

    The kernel is given what was uploaded, the settings' values and the parameters', and returns
    a plane, or the picture's colour, on the device. A `recorded` kernel is traced once a view: for
    every frame that takes Python longer than many a frame does. It may make no arrays from numbers
    of Python.
    """

    def __init__(
        self,
        name: str,
        settings: dict[str, Any],
        parameters: Any,
        upload: Callable[[View], Any],
        kernel: Callable[..., Any],
        *,
        recorded: bool = False,
        family: str = SCREEN_SPACE,
    ) -> None:
        if recorded:
            kernel = dr.freeze(kernel, limit=4, warn_after=1 << 30)
        self.name, self.settings, self.parameters, self.family = name, settings, parameters, family
        self._upload, self._kernel = upload, kernel
        self._frame: Any = None
        self._shape = (0, 0)

    def prepare(self, view: View) -> None:
        """Put the view on the device."""
        self._frame, self._shape = self._upload(view), (view.height, view.width)

    def shade(self, view: View) -> Float:
        """(3, H, W), or (H, W) of a plane, of the prepared view."""
        values = [*self.settings.values(), *astuple(self.parameters)]
        planes = self._kernel(self._frame, *values).numpy()
        result: Float = planes.reshape(*planes.shape[:-1], *self._shape)
        return result
