"""What rivals that see surfaces share: a view on the device, samples along slices, and a filter.

Positions follow from depths, one gather a sample, as in XeGTAO. Parameters are arguments of the
compiled function, so that every setting shares it. All lengths are in units of the effect radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from deepshade_report.baselines.picture import Grid, mi
from deepshade_report.view import Float, View

NEAREST = 1.3  # pixels between a pixel and its first sample, so that it never meets itself
GOLDEN = 0.61803398875
TINY = 1e-12
SECTORS = 32  # of a slice, as bits


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Screen(Grid):
    """A view on the device; depths are in units of the effect radius, 0 where there is nothing.

    `depth`, `normal` (unit), `turn` and `offset` (jitter) are
    flat, in row-major order; `scale` is pixels per unit at distance 1, `axis` where the optical
    axis meets the picture.
    """

    depth: Any
    normal: Any
    turn: Any
    offset: Any
    scale: Any
    axis: Any

    def position(self, column: Any, row: Any, depth: Any) -> Any:
        """Camera-space position, in radii, of a pixel's centre at a depth."""
        x = (mi.Float(column) + 0.5 - self.axis.x) * depth / self.scale
        y = (self.axis.y - 0.5 - mi.Float(row)) * depth / self.scale
        return mi.Vector3f(x, y, -depth)


def open_screen(view: View) -> Screen:
    """`view` on the device. Pixels that aren't finite, or behind the eye, hold nothing.

    A method that uses no normals needs none.
    """
    height, width = view.background.shape
    position = view.attributes["position"]
    normal = view.attributes.get("normal", np.ones_like(position))
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
        **vars(Grid.of(height, width)),
        depth=mi.Float(np.where(there, depth, np.float32(0)).ravel()),
        normal=_unit(mi.Vector3f(*(mi.Float(plane) for plane in planes))),
        turn=mi.Float(turn),
        offset=mi.Float(offset),
        scale=dr.opaque(mi.Float, camera.pixels_per_unit),
        axis=mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y)),
    )
    dr.eval(screen.normal)
    return screen


def _unit(vector: Any) -> Any:
    """A direction, where there is one."""
    return vector * dr.rcp(dr.maximum(dr.norm(vector), TINY))


def jitter(column: NDArray[np.int64], row: NDArray[np.int64]) -> tuple[Float, Float]:
    """Shares of a turn and of a step in [0, 1) for pixels, repeating every 4 x 4 of them.

    Jimenez et al. 2016, "Practical Real-Time Strategies for Accurate Indirect Occlusion", course
    notes, section on spatial noise: any 4 x 4 pixels together hold 16 turns and 4 offsets.
    """
    turn = ((((column + row) & 3) << 2) + (column & 3)) / 16
    step = ((row - column) & 3) / 4
    return turn.astype(np.float32), step.astype(np.float32)


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


def across(eye: Any, sin: Any, cos: Any) -> Any:
    """The unit vector of a slice's plane that is square to the eye's ray, along its direction."""
    towards = cos * eye.x + sin * eye.y
    scale = dr.rsqrt(dr.maximum(1 - dr.square(towards), TINY))
    return (mi.Vector3f(cos, sin, 0) - towards * eye) * scale


def stride(
    screen: Screen, along: Any, spread: Any, index: Any, step: Any, steps: Any, cos: Any, sin: Any
) -> tuple[Any, Any]:
    """Pixels to the right and down to a step's sample."""
    share = mi.Float(index + step * steps) * GOLDEN
    share += screen.offset
    share = (share - dr.floor(share) + mi.Float(step)) / mi.Float(steps)
    distance = dr.fma(dr.power(share, spread), along, NEAREST)
    return distance * cos, -distance * sin


def below(bound: Any) -> Any:
    """The lowest `bound` of 32 bits, all from 32 on."""
    return dr.select(bound >= SECTORS, mi.UInt32(0xFFFFFFFF), (mi.UInt32(1) << bound) - 1)


def smoothed(screen: Screen, image: Any, blur: int, edge: float, *, bent: bool = False) -> Any:
    """`image` (a plane, or three) filtered over `blur` pixels, down columns, then along rows.

    The separable cross-bilateral filter of Bavoil and Sainz 2008 ("Image-Space Horizon-Based
    Ambient Occlusion", section on noise): a neighbour's weight falls with its distance on the
    screen and to zero where its depth differs by `edge` radii; with `bent`, also with the cosine
    between the normals, to zero at 60 degrees.
    """
    dr.eval(image)
    if blur > 0:
        reach = [dr.opaque(mi.Int32, min(blur, size - 1)) for size in screen.shape]
        fade = dr.opaque(mi.Float, -2 / (blur + 1) ** 2)
        sharpness = dr.opaque(mi.Float, 1 / edge)
        image = _smooth(screen, image, reach[0], fade, sharpness, down=1, bent=bent)
        dr.eval(image)
        image = _smooth(screen, image, reach[1], fade, sharpness, down=0, bent=bent)
    return image


@dr.syntax
def _smooth(
    screen: Screen, image: Any, reach: Any, fade: Any, sharpness: Any, *, down: int, bent: bool
) -> Any:
    column, row = screen.pixels()
    total, weights = type(image)(image), mi.Float(1)
    shift = mi.Int32(1)
    while shift <= reach:
        gauss = dr.exp(fade * mi.Float(shift * shift))
        for side in (1, -1):  # unrolled
            c, r = column + side * shift * (1 - down), row + side * shift * down
            other, inside = screen.look(screen.depth, c, r)
            value, _ = screen.look(image, c, r)
            near = dr.maximum(1 - dr.abs(other - screen.depth) * sharpness, 0)
            if dr.hint(bent, mode="scalar"):
                normal, _ = screen.look(screen.normal, c, r)
                near *= dr.maximum(2 * dr.dot(normal, screen.normal) - 1, 0)
            weight = dr.select(inside, near * gauss, 0)
            total = dr.fma(weight, value, total)
            weights += weight
        shift += 1
    return total / weights
