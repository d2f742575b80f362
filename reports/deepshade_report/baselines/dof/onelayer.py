"""Depth of field by lens rays marched through the picture: about the most that one layer tells.

No shader for real time: every pixel sends many rays through the lens, and each looks at every pixel
that it passes, from the nearest surface's distance to the farthest's. A ray through the point u of
a round lens of radius 1 lies, where surfaces have the blur radius r (near < 0), r u pixels from its
own: both are linear in 1/depth (M. Potmesil and I. Chakravarty, "Synthetic Image Generation with a
Lens and Aperture Camera Model", ACM TOG 1982), so rays are straight lines over the picture and its
radii. A ray ends where it meets a surface. Where it passes behind one, the buffer doesn't hold what
it meets; that is taken from where the ray was last seen. What leaves the picture doesn't count.
There is no filter: what noise is left falls with the number of rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from deepshade_report.baselines.dof.pyramid import upload
from deepshade_report.baselines.picture import Filter, Grid, mi
from deepshade_report.method import LIMIT
from deepshade_workers.sampling import pixel_streams, random_pair, strata

# rays a pixel, as `strata` rounds them
SETTINGS = (64, 512)
QUICK = (64,)
_LONGEST = 64.0  # pixels: larger blur radii are cut to that


@dataclass(frozen=True)
class Parameters:
    """There are none."""


def onelayer(rays: int) -> Filter:
    """Marched rays as a Method."""
    return Filter("marched rays", {"rays": rays}, Parameters(), upload, _shade, family=LIMIT)


def methods(quick: bool) -> list[Filter]:
    """The method at its numbers of rays; in a quick report, the fewest."""
    return [onelayer(rays) for rays in (QUICK if quick else SETTINGS)]


def _shade(frame: tuple[Grid, Any, Any], rays: int) -> Any:
    columns, rows = (dr.opaque(mi.UInt32, n) for n in strata(2 * rays))
    grid, light, radius = frame
    return _march(grid, light, dr.clip(radius, -_LONGEST, _LONGEST), columns, rows)


@dr.syntax
def _march(grid: Grid, light: Any, radius: Any, columns: Any, rows: Any) -> Any:
    column, row = grid.pixels()
    stream = pixel_streams(grid.shape[0] * grid.shape[1], 0)
    size = mi.Point2f(mi.Float(columns), mi.Float(rows))
    nearest, farthest = dr.min(radius), dr.max(radius)
    dr.eval(radius, nearest, farthest)
    total, counted = mi.Color3f(0), mi.Float(0)
    cell = mi.UInt32(0)
    while cell < columns * rows:
        corner = mi.Point2f(mi.Float(cell % columns), mi.Float(cell // columns))
        lens = mi.warp.square_to_uniform_disk((corner + random_pair(stream, cell)) / size)
        # one pixel at a time along the longer axis
        step = dr.rcp(dr.maximum(dr.maximum(dr.abs(lens.x), dr.abs(lens.y)), 1e-4))
        before, now = nearest - 1, nearest
        going = mi.Bool(True)
        while going:
            across, down = mi.Int32(dr.round(lens.x * now)), mi.Int32(dr.round(lens.y * now))
            at, inside = grid.place(column + across, row + down)
            surface = dr.gather(mi.Float, radius, at, inside)
            met = inside & (now >= surface)
            # where it goes through the surface, or else was last seen
            through = dr.clip(surface, before, now)
            across = mi.Int32(dr.round(lens.x * through))
            at, inside = grid.place(column + across, row + mi.Int32(dr.round(lens.y * through)))
            met &= inside
            total += dr.gather(mi.Color3f, light, at, met)
            counted += dr.select(met, 1, 0)
            going = ~met & (now < farthest)
            before = now
            now = dr.minimum(now + step, farthest)
        cell += 1
    own = dr.gather(mi.Color3f, light, grid.at(column, row))
    return dr.select(counted > 0, total / dr.maximum(counted, 1), own)
