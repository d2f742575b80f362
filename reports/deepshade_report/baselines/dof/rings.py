"""Depth of field by gathering over rings, with a near layer of its own.

Background: G. Abadie, "A Life of a Bokeh", SIGGRAPH 2018 course "Advances in Real-Time Rendering".
Samples on rings, the largest first, count where their own circle of confusion reaches the pixel
(scatter as gather), by the inverse of its area; what has about a ring's radius forms a bucket, what
is larger belongs to those before, and a bucket hides them as much as its samples are opaque and
its circles smaller. Foreground: J. Jimenez, "Next Generation Post Processing in Call of Duty:
Advanced Warfare", SIGGRAPH 2014: over the largest near circle of the neighbourhood, two layers by
depth, opaque as far as samples cover the kernel, opposite samples sharing the nearer one's weight
to guess what is hidden. As in Filament (Google, Apache-2.0, `filament/src/materials/dof`), whose
constants are the published parameters; its tone-map weights and its median are left out, since
light is to pass linearly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.dof.pyramid import (
    LEVELS,
    TILE_LEVEL,
    Pyramid,
    build,
    near_reach,
    texel,
    upload,
)
from deepshade_report.baselines.picture import Filter, Grid, gradient_noise, mi
from deepshade_report.tuning import Ranges, Tunable, tuned

# rings, and whether at half resolution, from cheap to best
SETTINGS = ((3, True), (4, True), (6, True), (4, False), (6, False), (8, False))
QUICK = ((4, True), (6, False))
TINY = 1e-12
UNLIKE = 0.01  # pixels of radius from which a texel counts for less when it is enlarged


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    Radii below `sharp` pixels show the picture as it is, from `sharp` + `fade` on it is blurred.
    `jitter` is the share of the gap between rings over which they are shifted at random. `coarse`
    is added to the level of resolution that fits the gap. `split` is by how many pixels of radius
    the near layers' two halves lie apart. Radii are cut to `longest` pixels.
    """

    sharp: float = 1.0
    fade: float = 1.0
    jitter: float = 1.0
    coarse: float = 0.0
    split: float = 2.0
    longest: float = 32.0


PUBLISHED = Parameters()
RANGES: Ranges = {
    "sharp": (0.0, 1.5),
    "fade": (0.2, 2.0),
    "jitter": (0.0, 1.0),
    "coarse": (-1.0, 1.0),
    "split": (0.5, 6.0),
    "longest": (24.0, 64.0),
}


def rings(count: int, half: bool, parameters: Parameters | None = None) -> Filter:
    """The gather as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "rings"))
    return Filter(
        "ring gather", {"rings": count, "half": half}, parameters, upload, shade, recorded=True
    )


TUNABLE = Tunable(partial(rings, 4, False), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The gather at its settings, from cheap to best; in a quick report, two of them."""
    return [rings(count, half) for count, half in (QUICK if quick else SETTINGS)]


def shade(frame: tuple[Grid, Any, Any], count: int, half: bool, *given: float) -> Any:
    """The blurred light of a frame, by the number of rings and the parameters."""
    grid, light, radius = frame
    numbers = dict(zip(RANGES, (dr.opaque(mi.Float, value) for value in given), strict=True))
    pyramid = build(grid, light, radius)
    reach = near_reach(pyramid, numbers["longest"])
    dr.eval(reach)
    kernel = Kernel(pyramid, dr.opaque(mi.Int32, int(half)), dr.opaque(mi.Int32, count), **numbers)
    base = pyramid.grids[int(half)]
    column, row = base.pixels()
    blurred, opacity = _blur(kernel, column, row, reach)
    if half:
        dr.eval(blurred, opacity)
        blurred, opacity = _enlarged(grid, pyramid, blurred, opacity)
    return blurred + light * (1 - opacity)


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Kernel:
    """What every pixel's gather is given: the pyramid, its finest level, rings and parameters."""

    pyramid: Pyramid
    base: Any
    count: Any
    sharp: Any
    fade: Any
    jitter: Any
    coarse: Any
    split: Any
    longest: Any

    def spread(self, size: Any) -> tuple[Any, ...]:
        """The gap between rings of a kernel, and the look-ups of the level that fits the gap."""
        gap = size / (mi.Float(self.count) - 0.5)
        level = dr.round(dr.log2(dr.maximum(gap, TINY)) + self.coarse)
        level = dr.clip(mi.Int32(level), self.base, LEVELS - 1)
        tables = (self.pyramid.starts, self.pyramid.widths, self.pyramid.heights)
        scale = 1 / mi.Float(1 << level)
        return gap, *(dr.gather(mi.Int32, table, level) for table in tables), scale

    def weight(self, radius: Any, scale: Any) -> Any:
        """A sample's light a unit area of its circle, which is a texel at least."""
        return 1 / dr.maximum(radius * radius, 0.5 / (scale * scale))


def _blur(kernel: Kernel, column: Any, row: Any, reach: Any) -> tuple[Any, Any]:
    """Blurred light, premultiplied, and its opacity."""
    pyramid, size = kernel.pyramid, mi.Float(1 << kernel.base)
    x, y = (mi.Float(column) + 0.5) * size, (mi.Float(row) + 0.5) * size
    sin, cos = dr.sincos(gradient_noise(column, row) * (2 * math.pi))
    far = 0.5 * dr.sqrt(gradient_noise(column + 47, row + 17)) * kernel.jitter
    noise = mi.Vector2f(cos, sin) * far
    radius = dr.gather(mi.Float, pyramid.radius, pyramid.texel(kernel.base, x, y))
    tile = pyramid.grids[TILE_LEVEL]
    edge = 1.0 / (1 << TILE_LEVEL)
    near = dr.gather(mi.Float, reach, tile.at(mi.Int32(x * edge), mi.Int32(y * edge)))
    back, back_opacity = _background(kernel, x, y, dr.minimum(radius, kernel.longest), noise, far)
    front, front_opacity = _foreground(kernel, x, y, near, noise)
    clear = 1 - front_opacity
    return front + back * clear, front_opacity + back_opacity * clear


@dr.syntax
def _background(kernel: Kernel, x: Any, y: Any, size: Any, noise: Any, far: Any) -> tuple[Any, Any]:
    active = size > kernel.sharp
    gap, start, width, height, scale = kernel.spread(size)
    x, y = x + noise.x * gap, y + noise.y * gap
    light, weights, radii = mi.Color3f(0), mi.Float(0), mi.Float(0)
    ring = kernel.count - 1
    while (ring >= 0) & active:
        taps = dr.maximum(8 * ring, 1)
        step = 2 * math.pi / mi.Float(taps)
        sin, cos = dr.sincos(step)
        down, right = dr.sincos(dr.select((ring & 1) == 1, 0.5 * step, 0))
        distance = gap * mi.Float(ring)
        right, down = right * distance, down * distance
        # where jitter shifts the ring's samples to, from the pixel
        shifted = dr.sqrt(distance * distance + dr.square(far * gap))
        border = distance + 0.5 * gap
        this, this_weights, this_radii = mi.Color3f(0), mi.Float(0), mi.Float(0)
        larger = mi.Float(0)
        tap = mi.Int32(0)
        while tap < taps:
            index = texel(start, width, height, scale, x + right, y + down)
            other = dr.minimum(dr.gather(mi.Float, kernel.pyramid.radius, index), kernel.longest)
            covers = dr.clip((other - shifted) * scale + 0.5, 0, 1)
            weight = dr.select(other > 0, covers * kernel.weight(other, scale), 0)
            before = dr.clip(other - border + 0.5, 0, 1)
            colour = dr.gather(mi.Color3f, kernel.pyramid.light, index) * weight
            light += colour * before
            weights += weight * before
            radii += weight * before * other
            this += colour * (1 - before)
            this_weights += weight * (1 - before)
            this_radii += weight * (1 - before) * other
            larger += before
            right, down = right * cos - down * sin, right * sin + down * cos
            tap += 1
        # how much this ring's bucket hides those before
        mean = this_radii / dr.maximum(this_weights, TINY)
        hidden = dr.clip(radii / dr.maximum(weights, TINY) - mean, 0, 1)
        opaque = 1 - larger / mi.Float(taps)
        keep = dr.select(this_weights > TINY, 1 - opaque * hidden, 1)
        light = light * keep + this
        weights = weights * keep + this_weights
        radii = radii * keep + this_radii
        ring -= 1
    t = dr.clip((size - kernel.sharp) / kernel.fade, 0, 1)
    opacity = dr.select(active & (weights > TINY), t * t * (3 - 2 * t), 0)
    return light * (opacity / dr.maximum(weights, TINY)), opacity


@dr.syntax
def _foreground(kernel: Kernel, x: Any, y: Any, size: Any, noise: Any) -> tuple[Any, Any]:
    active = size > kernel.sharp
    gap, start, width, height, scale = kernel.spread(size)
    x, y = x + noise.x * gap, y + noise.y * gap
    front, front_weights = mi.Color3f(0), mi.Float(0)
    back, back_weights = mi.Color3f(0), mi.Float(0)
    ring = mi.Int32(0)
    while (ring < kernel.count) & active:
        taps = dr.maximum(4 * ring, 1)  # pairs, and the middle one alone
        step = math.pi / mi.Float(taps)
        sin, cos = dr.sincos(step)
        down, right = dr.sincos(dr.select((ring & 1) == 1, 0.5 * step, 0))
        distance = gap * mi.Float(ring)
        right, down = right * distance, down * distance
        share = dr.select(ring == 0, 0.5, 1)  # the middle is met from both sides
        tap = mi.Int32(0)
        while tap < taps:
            one = texel(start, width, height, scale, x + right, y + down)
            two = texel(start, width, height, scale, x - right, y - down)
            nearest = dr.minimum(
                dr.gather(mi.Float, kernel.pyramid.radius, one),
                dr.gather(mi.Float, kernel.pyramid.radius, two),
            )
            other = dr.minimum(-nearest, kernel.longest)
            weight = dr.clip((other - kernel.sharp) / kernel.fade, 0, 1)
            weight *= dr.clip((other - distance) * scale + 0.5, 0, 1)
            weight *= kernel.weight(other, scale) * share
            colour = dr.gather(mi.Color3f, kernel.pyramid.light, one)
            colour += dr.gather(mi.Color3f, kernel.pyramid.light, two)
            behind = weight * dr.clip((size - other - kernel.split) / kernel.split, 0, 1)
            front += colour * (weight - behind)
            front_weights += 2 * (weight - behind)
            back += colour * behind
            back_weights += 2 * behind
            right, down = right * cos - down * sin, right * sin + down * cos
            tap += 1
        ring += 1
    count = mi.Float(kernel.count)
    samples = dr.square(2 * count - 1)
    whole = samples * kernel.weight(size * (count + 0.5) / count, scale)
    first, second = (dr.clip(w / whole, 0, 1) for w in (front_weights, back_weights))
    light = front * (first / dr.maximum(front_weights, TINY))
    light += back * (second / dr.maximum(back_weights, TINY)) * (1 - first)
    opacity = 1 - (1 - first) * (1 - second)
    return dr.select(active, light, 0), dr.select(active, opacity, 0)


def _enlarged(grid: Grid, pyramid: Pyramid, blurred: Any, opacity: Any) -> tuple[Any, Any]:
    """Both at full resolution, from the four nearest texels, of about the pixel's own radius."""
    base, start = pyramid.grids[1], dr.gather(mi.Int32, pyramid.starts, mi.UInt32(1))
    column, row = grid.pixels()
    radius = dr.gather(mi.Float, pyramid.radius, dr.arange(mi.UInt32, dr.width(column)))
    x, y = (mi.Float(column) - 0.5) / 2, (mi.Float(row) - 0.5) / 2
    left, top = dr.floor(x), dr.floor(y)
    light, solid, weights = mi.Color3f(0), mi.Float(0), mi.Float(0)
    for down in (0, 1):  # unrolled
        for right in (0, 1):
            index = base.at(mi.Int32(left) + right, mi.Int32(top) + down)
            weight = (1 - dr.abs(x - left - right)) * (1 - dr.abs(y - top - down))
            other = dr.gather(mi.Float, pyramid.radius, mi.UInt32(start + mi.Int32(index)))
            weight /= UNLIKE + dr.abs(other - radius)
            light += dr.gather(mi.Color3f, blurred, index) * weight
            solid += dr.gather(mi.Float, opacity, index) * weight
            weights += weight
    return light / weights, solid / weights
