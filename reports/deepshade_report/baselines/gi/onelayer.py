"""Indirect light by rays marched through the depth buffer: about the most that one layer tells.

No shader for real time: every pixel sends many cosine-weighted rays, and each looks at every pixel
that it passes on its way, up to the radius or the picture's edge (M. McGuire and M. Mara,
"Efficient GPU Screen-Space Ray Tracing", JCGT 2014: depth is interpolated as 1/z along a line of
pixels). A ray ends in a pixel's surface where it lies behind that surface's tangent plane, but by
no more than a thickness behind the pixel; that is the one thing that the buffer leaves open. What
is met from behind is black: the buffer doesn't hold its other side's light. There is no filter:
what noise is left falls with the number of rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr

from deepshade_report.baselines.gi.lit import Lit, open_lit
from deepshade_report.baselines.picture import Filter, mi
from deepshade_report.method import LIMIT
from deepshade_report.tuning import Ranges, Tunable, tuned
from deepshade_workers.sampling import pixel_streams, random_pair, strata

# rays a pixel, as `strata` rounds them
SETTINGS = (16, 64)
QUICK = (16,)
# Rays end before the eye, at this share of their origin's depth.
_NEAREST = 0.02


@dataclass(frozen=True)
class Parameters:
    """How far behind a pixel, in radii of the effect, its surface still stops rays."""

    thickness: float = 0.3


PUBLISHED = Parameters()
RANGES: Ranges = {"thickness": (0.02, 2.0)}


def onelayer(rays: int, parameters: Parameters | None = None) -> Filter:
    """Marched rays as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or replace(PUBLISHED, **tuned(__package__, "onelayer"))
    return Filter("marched rays", {"rays": rays}, parameters, open_lit, _shade, family=LIMIT)


TUNABLE = Tunable(partial(onelayer, QUICK[0]), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method at its numbers of rays; in a quick report, the fewest."""
    return [onelayer(rays) for rays in (QUICK if quick else SETTINGS)]


def _shade(lit: Lit, rays: int, thickness: float) -> Any:
    columns, rows = (dr.opaque(mi.UInt32, n) for n in strata(2 * rays))
    image = _march(lit, columns, rows, dr.opaque(mi.Float, thickness))
    return dr.select(lit.screen.depth > 0, image, 0)


@dr.syntax
def _march(lit: Lit, columns: Any, rows: Any, thickness: Any) -> Any:
    screen = lit.screen
    column, row = screen.pixels()
    depth = screen.depth
    here = screen.position(column, row, depth)
    stream = pixel_streams(screen.shape[0] * screen.shape[1], 0)
    frame = mi.Frame3f(screen.normal)
    size = mi.Point2f(mi.Float(columns), mi.Float(rows))
    total = mi.Color3f(0)
    cell = mi.UInt32(0)
    while (cell < columns * rows) & (depth > 0):
        corner = mi.Point2f(mi.Float(cell % columns), mi.Float(cell // columns))
        point = (corner + random_pair(stream, cell)) / size
        direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(point))
        # The end: a radius away, but in front of the eye.
        towards = dr.maximum(direction.z, 1e-9)
        far = dr.minimum(1, (1 - _NEAREST) * depth / towards)
        end = here + direction * far
        last = -screen.scale / end.z
        right = end.x * last + screen.axis.x - mi.Float(column) - 0.5
        down = screen.axis.y - end.y * last - mi.Float(row) - 0.5
        # One pixel at a time along the longer axis; 1/z is linear in the picture.
        count = dr.maximum(dr.maximum(dr.abs(right), dr.abs(down)), 1e-6)
        step = mi.Float(1)
        start, rise = dr.rcp(depth), (dr.rcp(-end.z) - dr.rcp(depth)) / count
        going = count >= 1
        while going:
            c = column + mi.Int32(dr.round(right * (step / count)))
            r = row + mi.Int32(dr.round(down * (step / count)))
            place, inside = screen.place(c, r)
            surface = dr.gather(mi.Vector4f, lit.surface, place, inside)
            along = dr.rcp(dr.fma(rise, step, start))
            exact = mi.Float(column) + right * (step / count)
            sunk = mi.Float(row) + down * (step / count)
            # Where the ray is, beside the pixel's centre, at its own depth.
            x = (exact + 0.5 - screen.axis.x) * along / screen.scale
            y = (screen.axis.y - 0.5 - sunk) * along / screen.scale
            delta = mi.Vector3f(x, y, -along) - screen.position(c, r, surface.w)
            normal = mi.Vector3f(surface.x, surface.y, surface.z)
            behind = (dr.dot(delta, normal) <= 0) & (along - surface.w < thickness)
            # Planes of shading normals bend away: what lies well before a pixel isn't behind it.
            met = inside & (surface.w > 0) & behind & (along > surface.w * (1 - 1e-3))
            lights = met & (dr.dot(normal, direction) < 0)
            sent = dr.gather(mi.Vector4f, lit.light, place, lights)
            total += mi.Color3f(sent.x, sent.y, sent.z)
            step += 1
            going = inside & ~met & (step <= count)
        cell += 1
    return total / mi.Float(columns * rows)
