"""What HBAO and GTAO share: a view on the device, samples along slices, and the filter.

Dr.Jit compiles each method into one vectorised function that keeps a pixel's whole march in
registers: the nearest that a processor comes to the shaders that these methods were made as. (As
separate tensor operations they took 8 to 12 times as long, and a comparison at the same
milliseconds flattered the networks.) On a machine with a GPU the kernels run there. Positions
follow from depths, one gather a sample, as in XeGTAO. Parameters are arguments of the compiled
function, so that every setting shares it. All lengths are in units of the effect radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade_report.tuning import Ranges
from deepshade_report.view import Float, View
from deepshade_workers.backend import mitsuba

mi = mitsuba()

NEAREST = 1.3  # pixels between a pixel and its first sample, so that it never meets itself
GOLDEN = 0.61803398875
TINY = 1e-12


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    `radius` multiplies the effect's. `falloff` in (0, 1] is the share of it over which samples
    lose their weight, up to the radius (HBAO: of its square). `bias` is how far over the tangent a
    sample must rise (HBAO: in radians, GTAO: in sines). `spread` is the power that draws samples
    towards the pixel. Occlusion is multiplied by `intensity`, what is left open is raised to
    `power`. `blur` is the filter's half width in pixels (0 = none), `edge` the depth step, in
    radii, that stops it.
    """

    radius: float
    falloff: float
    bias: float
    spread: float
    intensity: float = 1.0
    power: float = 1.0
    blur: int = 3
    edge: float = 0.2


RANGES: Ranges = {
    "radius": (0.4, 2.5),
    "falloff": (0.05, 1.0),
    "bias": (0.0, 0.6),
    "spread": (1.0, 2.5),
    "intensity": (0.5, 2.5),
    "power": (0.4, 2.5),
    "blur": (0, 6),
    "edge": (0.02, 0.5),
}


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Screen:
    """A view on the device; depths are in units of the effect radius, 0 where there is nothing.

    All but `shape` are Dr.Jit values. `depth`, `normal` (unit), `turn` and `offset` (jitter) are
    flat, in row-major order; `scale` is pixels per unit at distance 1, `axis` where the optical
    axis meets the picture.
    """

    shape: tuple[int, int]
    width: Any
    height: Any
    depth: Any
    normal: Any
    turn: Any
    offset: Any
    scale: Any
    axis: Any

    def pixels(self) -> tuple[Any, Any]:
        """Column and row of every pixel."""
        index = dr.arange(mi.Int32, dr.width(self.depth))
        row = index // self.width
        return index - row * self.width, row

    def position(self, column: Any, row: Any, depth: Any) -> Any:
        """Camera-space position, in radii, of a pixel's centre at a depth."""
        x = (mi.Float(column) + 0.5 - self.axis.x) * depth / self.scale
        y = (self.axis.y - 0.5 - mi.Float(row)) * depth / self.scale
        return mi.Vector3f(x, y, -depth)

    def look(self, plane: Any, column: Any, row: Any) -> tuple[Any, Any]:
        """Any pixel's value of a plane, and whether it lies in the picture."""
        inside = (column >= 0) & (row >= 0) & (column < self.width) & (row < self.height)
        place = mi.UInt32(row * self.width + column)
        return dr.gather(mi.Float, plane, place, inside), inside


def open_screen(view: View) -> Screen:
    """`view` on the device. Pixels that aren't finite, or behind the eye, hold nothing."""
    height, width = view.background.shape
    position, normal = (view.attributes[name] for name in ("position", "normal"))
    depth = position[2] / np.float32(-view.radius)
    with np.errstate(invalid="ignore"):
        there: NDArray[np.bool_] = ~view.background & (depth > 0) & np.isfinite(depth)
        there &= np.isfinite(position).all(0) & np.isfinite(normal).all(0) & normal.any(0)
    row, column = np.divmod(np.arange(height * width), max(width, 1))
    turn, offset = jitter(column, row)
    planes = [np.where(there, plane, np.float32(0)).ravel() for plane in normal]
    camera = view.camera
    x, y = camera.width / 2 - camera.x0, camera.height / 2 - camera.y0
    screen = Screen(
        (height, width),
        dr.opaque(mi.Int32, width),
        dr.opaque(mi.Int32, height),
        mi.Float(np.where(there, depth, np.float32(0)).ravel()),
        dr.normalize(mi.Vector3f(*(mi.Float(plane) for plane in planes))),
        mi.Float(turn),
        mi.Float(offset),
        dr.opaque(mi.Float, camera.pixels_per_unit),
        mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y)),
    )
    dr.eval(screen.normal)
    return screen


def jitter(column: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[Float, Float]:
    """Shares of a turn and of a step in [0, 1) for pixels, repeating every 4 x 4 of them.

    Jimenez et al. 2016, "Practical Real-Time Strategies for Accurate Indirect Occlusion", course
    notes, section on spatial noise: any 4 x 4 pixels together hold 16 turns and 4 offsets.
    """
    turn = ((((column + row) & 3) << 2) + (column & 3)) / 16
    step = ((row - column) & 3) / 4
    return turn.astype(np.float32), step.astype(np.float32)


class Marching:
    """A screen-space Method.

    `settings` are how many directions or slices, and how many steps in each. The `kernel` gives
    every pixel's occlusion of a Screen, these counts and all parameters but the filter's two.
    """

    family = "screen-space"

    def __init__(
        self,
        name: str,
        settings: dict[str, Any],
        parameters: Parameters,
        kernel: Callable[..., Any],
    ) -> None:
        self.name, self.settings = name, settings
        self.parameters, self.kernel = parameters, kernel
        self._screen: Screen | None = None

    def prepare(self, view: View) -> None:
        """Put the view on the device."""
        self._screen = open_screen(view)

    def shade(self, view: View) -> Float:
        """(H, W) in [0, 1], 1 = open, of the prepared view."""
        assert self._screen is not None
        *given, blur, edge = astuple(self.parameters)
        counts = [dr.opaque(mi.UInt32, count) for count in self.settings.values()]
        numbers = [dr.opaque(mi.Float, float(value)) for value in given]
        return finish(self._screen, self.kernel(self._screen, *counts, *numbers), blur, edge)


def start(screen: Screen, column: Any, row: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Every pixel's place, direction to the eye, cosine between that and its normal, radius."""
    depth = screen.depth
    here = screen.position(column, row, depth)
    eye = dr.normalize(-screen.position(column, row, mi.Float(1)))  # at the eye, too
    reach = screen.scale / depth
    active = (depth > 0) & (reach >= NEAREST)  # less than a pixel occludes nothing to be seen
    reach = dr.minimum(reach, mi.Float(2 * dr.maximum(screen.width, screen.height)))
    return here, eye, dr.maximum(dr.dot(screen.normal, eye), 0), reach, active


def plane(screen: Screen, eye: Any, facing: Any, index: Any, count: Any) -> tuple[Any, ...]:
    """A slice's direction on screen, the length of the normal in it, and its tilt's sine."""
    normal = screen.normal
    sin, cos = dr.sincos((screen.turn + mi.Float(index)) * (math.pi / mi.Float(count)))
    towards = cos * eye.x + sin * eye.y
    ahead = cos * normal.x + sin * normal.y - towards * dr.dot(normal, eye)
    ahead *= dr.rsqrt(dr.maximum(1 - dr.square(towards), TINY))
    length = dr.sqrt(dr.square(ahead) + dr.square(facing))
    return sin, cos, length, ahead / dr.maximum(length, TINY)


def stride(
    screen: Screen, along: Any, spread: Any, index: Any, step: Any, steps: Any, cos: Any, sin: Any
) -> tuple[Any, Any]:
    """Pixels to the right and down to a step's sample."""
    share = mi.Float(index + step * steps) * GOLDEN
    share += screen.offset
    share = (share - dr.floor(share) + mi.Float(step)) / mi.Float(steps)
    distance = dr.fma(dr.power(share, spread), along, NEAREST)
    return distance * cos, -distance * sin


def sample(
    screen: Screen, here: Any, eye: Any, column: Any, row: Any, right: Any, down: Any, side: int
) -> tuple[Any, Any]:
    """A sample's elevation (sine) and squared distance; far off for nothing."""
    c = mi.Int32(dr.round(mi.Float(column) + side * right))
    r = mi.Int32(dr.round(mi.Float(row) + side * down))
    depth, inside = screen.look(screen.depth, c, r)
    delta = screen.position(c, r, depth) - here
    squared = dr.squared_norm(delta)
    elevation = dr.dot(delta, eye) * dr.rsqrt(dr.maximum(squared, TINY))
    return elevation, dr.select(inside & (depth > 0), squared, 1e18)


def finish(screen: Screen, image: Any, blur: int, edge: float) -> Float:
    """(H, W): `image` filtered over `blur` pixels, down columns, then along rows.

    The separable cross-bilateral filter of Bavoil and Sainz 2008 ("Image-Space Horizon-Based
    Ambient Occlusion", section on noise): a neighbour's weight falls with its distance on the
    screen and to zero where its depth differs by `edge` radii.
    """
    dr.eval(image)
    if blur > 0:
        reach = [dr.opaque(mi.Int32, min(blur, size - 1)) for size in screen.shape]
        fade = dr.opaque(mi.Float, -2 / (blur + 1) ** 2)
        sharpness = dr.opaque(mi.Float, 1 / edge)
        image = _smooth(screen, image, reach[0], fade, sharpness, down=1)
        dr.eval(image)
        image = _smooth(screen, image, reach[1], fade, sharpness, down=0)
    image = dr.select(screen.depth > 0, dr.clip(image, 0, 1), 1)
    result: Float = image.numpy().reshape(screen.shape)
    return result


@dr.syntax
def _smooth(screen: Screen, image: Any, reach: Any, fade: Any, sharpness: Any, *, down: int) -> Any:
    column, row = screen.pixels()
    total, weights = mi.Float(image), mi.Float(1)
    shift = mi.Int32(1)
    while shift <= reach:
        gauss = dr.exp(fade * mi.Float(shift * shift))
        for side in (1, -1):  # unrolled
            c, r = column + side * shift * (1 - down), row + side * shift * down
            other, inside = screen.look(screen.depth, c, r)
            value, _ = screen.look(image, c, r)
            near = dr.maximum(1 - dr.abs(other - screen.depth) * sharpness, 0)
            weight = dr.select(inside, near * gauss, 0)
            total = dr.fma(weight, value, total)
            weights += weight
        shift += 1
    return total / weights
