"""HBAO and GTAO as compiled kernels: the same sums as in `hbao` and `gtao`, several times faster.

Dr.Jit turns each method into one vectorised function that keeps a pixel's whole march in
registers: the nearest that a processor comes to the shaders that these methods were made as. Made
of separate array operations, each step goes through memory, and a comparison at the same
milliseconds would flatter the networks. On a machine with a GPU the kernels run there.

Positions follow from depths, one gather a sample, as in XeGTAO. Parameters are arguments of the
compiled function, so that every setting shares it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade_report.baselines.ao.gtao import Parameters as GTAOParameters
from deepshade_report.baselines.ao.hbao import Parameters as HBAOParameters
from deepshade_report.baselines.ao.horizons import GOLDEN, NEAREST, jitter
from deepshade_report.method import Float, View
from deepshade_workers.backend import mitsuba

mi = mitsuba()

_TINY = 1e-12


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
    depth = np.asarray(view.position[2], np.float32) / np.float32(-view.radius)
    normal = np.asarray(view.normal, np.float32)
    with np.errstate(invalid="ignore"):
        there: NDArray[np.bool_] = ~view.background & (depth > 0) & np.isfinite(depth)
        there &= np.isfinite(view.position).all(0) & np.isfinite(normal).all(0) & normal.any(0)
    row, column = np.divmod(np.arange(height * width), max(width, 1))
    turn, offset = jitter(column, row)
    planes = [np.where(there, plane, np.float32(0)).ravel() for plane in normal]
    x, y = view.optical_axis()
    screen = Screen(
        (height, width),
        dr.opaque(mi.Int32, width),
        dr.opaque(mi.Int32, height),
        mi.Float(np.where(there, depth, np.float32(0)).ravel()),
        dr.normalize(mi.Vector3f(*(mi.Float(plane) for plane in planes))),
        mi.Float(turn),
        mi.Float(offset),
        dr.opaque(mi.Float, view.pixel_scale()),
        mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y)),
    )
    dr.eval(screen.normal)
    return screen


def gtao(screen: Screen, slices: int, steps: int, p: GTAOParameters) -> Float:
    """(H, W) ambient occlusion in [0, 1], 1 = open, as `gtao.occlude` computes it."""
    given = (p.radius, p.falloff, p.bias, p.thickness, p.thin, p.spread, p.intensity, p.power)
    numbers = [dr.opaque(mi.Float, float(value)) for value in given]
    counts = [dr.opaque(mi.UInt32, value) for value in (slices, steps)]
    return _finish(screen, _gtao(screen, *counts, *numbers), p.blur, p.edge)


def hbao(screen: Screen, directions: int, steps: int, p: HBAOParameters) -> Float:
    """(H, W) ambient occlusion in [0, 1], 1 = open, as `hbao.occlude` computes it."""
    given = (p.radius, p.falloff, p.bias, p.spread, p.intensity, p.power)
    numbers = [dr.opaque(mi.Float, float(value)) for value in given]
    counts = [dr.opaque(mi.UInt32, value) for value in (max(directions // 2, 1), steps)]
    return _finish(screen, _hbao(screen, *counts, *numbers), p.blur, p.edge)


@dr.syntax
def _gtao(
    screen: Screen,
    slices: Any,
    steps: Any,
    radius: Any,
    falloff: Any,
    bias: Any,
    thickness: Any,
    thin: Any,
    spread: Any,
    intensity: Any,
    power: Any,
) -> Any:
    column, row = screen.pixels()
    here, eye, facing, reach, active = _start(screen, column, row)
    fade = -1 / (radius * falloff)
    stretch = dr.square(1 + thin) - 1
    total = mi.Float(0)
    index = mi.UInt32(0)
    while (index < slices) & active:
        sin, cos, length, tilt = _plane(screen, eye, facing, index, slices)
        first, second = mi.Float(-tilt), mi.Float(tilt)
        step = mi.UInt32(0)
        while step < steps:
            right, down = _stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            seen = []
            for side, low in ((1, -tilt), (-1, tilt)):  # unrolled
                elevation, squared, deep = _sample(
                    screen, here, eye, column, row, right, down, side
                )
                far = dr.sqrt(dr.fma(dr.square(deep), stretch, squared))
                weight = dr.clip(dr.fma(far, fade, 1 / falloff), 0, 1)
                seen.append(dr.lerp(low, elevation - bias, weight))
            first = _raised(first, seen[0], thickness)
            second = _raised(second, seen[1], thickness)
            step += 1
        h0 = dr.acos(dr.clip(dr.maximum(first, -tilt), -1, 1))
        h1 = -dr.acos(dr.clip(dr.maximum(second, tilt), -1, 1))
        cosine = facing / dr.maximum(length, _TINY)
        angle = dr.safe_acos(cosine)
        lean = dr.select(tilt < 0, -angle, angle)
        arc = 2 * cosine + 2 * (h0 + h1) * tilt - dr.cos(2 * h0 - lean) - dr.cos(2 * h1 - lean)
        total += dr.maximum(arc * 0.25 * length, 0)
        index += 1
    visible = dr.clip(1 + (total / mi.Float(slices) - 1) * intensity, 0, 1)
    return dr.select(active, dr.power(visible, power), 1)


@dr.syntax
def _hbao(
    screen: Screen,
    pairs: Any,
    steps: Any,
    radius: Any,
    falloff: Any,
    bias: Any,
    spread: Any,
    intensity: Any,
    power: Any,
) -> Any:
    column, row = screen.pixels()
    here, eye, facing, reach, active = _start(screen, column, row)
    slope = -1 / (dr.square(radius) * falloff)
    total = mi.Float(0)
    index = mi.UInt32(0)
    while (index < pairs) & active:
        sin, cos, _, tilt = _plane(screen, eye, facing, index, pairs)
        first, second = _lifted(-tilt, bias), _lifted(tilt, bias)
        step = mi.UInt32(0)
        while step < steps:
            right, down = _stride(screen, reach * radius, spread, index, step, steps, cos, sin)
            rises = []
            for side, horizon in ((1, first), (-1, second)):  # unrolled
                elevation, squared, _ = _sample(screen, here, eye, column, row, right, down, side)
                weight = dr.clip(dr.fma(squared, slope, 1 / falloff), 0, 1)
                rise = dr.select(weight > 0, dr.maximum(elevation - horizon, 0), 0)
                total = dr.fma(weight, rise, total)
                rises.append(rise)
            first += rises[0]
            second += rises[1]
            step += 1
        index += 1
    visible = dr.clip(1 - total * intensity / (2 * mi.Float(pairs)), 0, 1)
    return dr.select(active, dr.power(visible, power), 1)


def _start(screen: Screen, column: Any, row: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Every pixel's place, direction to the eye, cosine between that and its normal, radius."""
    depth = screen.depth
    here = screen.position(column, row, depth)
    eye = dr.normalize(-screen.position(column, row, mi.Float(1)))  # at the eye, too
    reach = screen.scale / depth
    active = (depth > 0) & (reach >= NEAREST)  # less than a pixel occludes nothing to be seen
    reach = dr.minimum(reach, mi.Float(2 * dr.maximum(screen.width, screen.height)))
    return here, eye, dr.maximum(dr.dot(screen.normal, eye), 0), reach, active


def _plane(screen: Screen, eye: Any, facing: Any, index: Any, count: Any) -> tuple[Any, ...]:
    """A slice's direction on screen, the length of the normal in it, and its tilt's sine."""
    normal = screen.normal
    sin, cos = dr.sincos((screen.turn + mi.Float(index)) * (math.pi / mi.Float(count)))
    towards = cos * eye.x + sin * eye.y
    ahead = cos * normal.x + sin * normal.y - towards * dr.dot(normal, eye)
    ahead *= dr.rsqrt(dr.maximum(1 - dr.square(towards), _TINY))
    length = dr.sqrt(dr.square(ahead) + dr.square(facing))
    return sin, cos, length, ahead / dr.maximum(length, _TINY)


def _stride(
    screen: Screen, along: Any, spread: Any, index: Any, step: Any, steps: Any, cos: Any, sin: Any
) -> tuple[Any, Any]:
    """Pixels to the right and down to a step's sample."""
    share = mi.Float(index + step * steps) * GOLDEN
    share += screen.offset
    share = (share - dr.floor(share) + mi.Float(step)) / mi.Float(steps)
    distance = dr.fma(dr.power(share, spread), along, NEAREST)
    return distance * cos, -distance * sin


def _sample(
    screen: Screen, here: Any, eye: Any, column: Any, row: Any, right: Any, down: Any, side: int
) -> tuple[Any, Any, Any]:
    """A sample's elevation (sine), squared distance and difference in z; far off for nothing."""
    c = mi.Int32(dr.round(mi.Float(column) + side * right))
    r = mi.Int32(dr.round(mi.Float(row) + side * down))
    depth, inside = screen.look(screen.depth, c, r)
    delta = screen.position(c, r, depth) - here
    squared = dr.squared_norm(delta)
    elevation = dr.dot(delta, eye) * dr.rsqrt(dr.maximum(squared, _TINY))
    return elevation, dr.select(inside & (depth > 0), squared, 1e18), delta.z


def _raised(horizon: Any, seen: Any, thickness: Any) -> Any:
    """The horizon after a sample; it sinks towards lower ones as if occluders were thin."""
    return dr.select(seen >= horizon, seen, dr.lerp(horizon, seen, thickness))


def _lifted(sin: Any, bias: Any) -> Any:
    """sin(t + bias), never past the zenith."""
    cos = dr.safe_sqrt(1 - dr.square(sin))
    up, over = dr.sincos(bias)
    lifted = sin * over + cos * up
    return dr.select(cos < up, dr.maximum(sin, lifted), lifted)


def _finish(screen: Screen, image: Any, blur: int, edge: float) -> Float:
    """(H, W): `image` filtered as `horizons.smooth` does, down columns, then along rows."""
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
