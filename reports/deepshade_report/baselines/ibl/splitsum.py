"""Image-based lighting as engines do it: harmonics of order 2, and a mip chain by roughness.

As in Filament (Google, Apache-2.0: its `cmgen`; R. Guy and M. Agopian, "Physically Based Rendering
in Filament", section 5.3). Diffuse: nine spherical harmonics of the environment, convolved by the
cosine (Ramamoorthi and Hanrahan 2001). Specular: the split sum (B. Karis, "Real Shading in Unreal
Engine 4", SIGGRAPH 2013 course): the environment blurred for a view along the normal, by
roughness in a mip chain, looked up along the mirrored view, times the lobe's directional albedo
from a table of roughness and angle.

Converted to a normalised Phong lobe: face on, cosⁿα max(0, N·ω) is a cosine lobe of exponent n + 1.
Filament's five mips have the roughness α = p⁴ with p (2 - p) = 0, ¼, ½, ¾, 1; as Phong exponents,
n = (1 / α² - 1) / 2, those are near 2^k - 1 for k = 0, 3, 6, 11, and the map itself. Its look-up
leans from the mirrored view to the normal by α² = 1 / (2n + 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import drjit as dr
import numpy as np

from deepshade.environments import world_to_map
from deepshade.environments.harmonics import harmonics, projected
from deepshade_report.baselines.lookup import MIRROR, Chain, colour, open_chain
from deepshade_report.baselines.picture import Filter, light, mi, plain
from deepshade_report.tuning import Ranges, Tunable, tuned
from deepshade_report.view import View, require
from deepshade_trainer.networks.phong import COLUMNS, ROWS, table

OCTAVES = 16  # the map itself stands at the exponent 2^16
# how many mips -> their exponents, as powers of two; the map itself comes last
MIPS = {5: (0, 3, 6, 11), 9: (0, 2, 4, 6, 8, 10, 12, 14), 16: tuple(range(15))}
SETTINGS = (5, 9, 16)
QUICK = (5, 16)
_SURFACE = 0.25  # the square of a normal's length; background has none


@dataclass(frozen=True)
class Parameters:
    """What can be tuned.

    The look-up leans to the normal by `lean` / (2n + 1). `sharper` is added to the octave that
    is looked up. Harmonics of degree l are divided by 1 + `window` (l (l + 1))², against ringing
    (P.-P. Sloan, "Stupid Spherical Harmonics Tricks", GDC 2008).
    """

    lean: float = 1.0
    sharper: float = 0.0
    window: float = 0.0


PUBLISHED = Parameters()
RANGES: Ranges = {"lean": (0.0, 10.0), "sharper": (-1.5, 1.5), "window": (0.0, 0.03)}


@dataclass  # not frozen: Dr.Jit writes a loop's state back
class Surface:
    """A view on the device: its attributes, flat, and what is looked up in the environment.

    `harmonics` are nine colours, in world space. By octave of the exponent, `mips` has the mip
    before it, `begins` that one's octave, and `gaps` one over the octaves to the next.
    """

    normal: Any
    view: Any
    diffuse: Any
    specular: Any
    gloss: Any
    chain: Chain
    harmonics: list[Any]
    albedo: Any
    mips: Any
    begins: Any
    gaps: Any


def split_sum(mips: int, parameters: Parameters | None = None) -> Filter:
    """The method as a Method, with the parameters that were tuned or those given."""
    parameters = parameters or Parameters(**tuned(__package__, "splitsum"))
    upload = partial(open_surface, mips)
    return Filter("split sum", {"mips": mips}, parameters, upload, reflected, recorded=True)


TUNABLE = Tunable(partial(split_sum, 9), PUBLISHED, RANGES)


def methods(quick: bool) -> list[Filter]:
    """The method with Filament's mips and with finer chains."""
    return [split_sum(mips) for mips in (QUICK if quick else SETTINGS)]


def open_surface(mips: int, view: View) -> Surface:
    """`view` on the device, under its environment."""
    octaves = [*MIPS[mips], OCTAVES]
    before = np.searchsorted(octaves[1:-1], np.arange(OCTAVES + 1), side="right")
    begins = np.array(octaves)[before]
    gaps = 1 / (np.array(octaves)[before + 1] - begins)
    planes = view.attributes
    normal, toward = (
        mi.Vector3f(*(plain(plane) for plane in planes[name])) for name in ("normal_world", "view")
    )
    lit = require(view)
    turned = projected(lit.environment, world_to_map(lit.degrees, lit.up))[:, :9].T
    return Surface(
        normal,
        toward,
        light(planes["diffuse"]),
        light(planes["specular"]),
        plain(planes["gloss"][0]),
        open_chain(view, [*(octave + 1 for octave in octaves[:-1]), MIRROR]),
        [colour(value) for value in turned],
        mi.Float(_albedo()),
        mi.UInt32(before),
        mi.Float(begins),
        mi.Float(gaps),
    )


@cache
def _albedo() -> Any:
    """E(n, μ) - max(μ, 0), flat: see `deepshade_trainer.networks.phong`."""
    return table(1)[0].ravel()


def reflected(surface: Surface, mips: int, lean: float, sharper: float, window: float) -> Any:
    """The radiance (Color3f) of every pixel."""
    lean, sharper, window = (dr.opaque(mi.Float, float(v)) for v in (lean, sharper, window))
    there = dr.squared_norm(surface.normal) > _SURFACE
    normal = surface.normal * dr.rsqrt(dr.maximum(dr.squared_norm(surface.normal), _SURFACE))
    known = dr.squared_norm(surface.view) > _SURFACE
    n = dr.clip(surface.gloss, 0, 2.0**OCTAVES - 1)
    cosine = dr.clip(dr.dot(normal, surface.view), -1, 1)
    mirrored = 2 * cosine * normal - surface.view
    mirrored = dr.lerp(mirrored, normal, dr.select(there, dr.minimum(lean / (2 * n + 1), 1), 0))
    octave = dr.clip(dr.log2(n + 1) + sharper, 0, OCTAVES)
    octave = dr.select(there, octave, OCTAVES)
    whole = mi.UInt32(octave)
    mip = dr.gather(mi.UInt32, surface.mips, whole)
    part = octave - dr.gather(mi.Float, surface.begins, whole)
    part *= dr.gather(mi.Float, surface.gaps, whole)
    place = surface.chain.angles(mirrored)
    near, far = (surface.chain.look(mip + extra, *place) for extra in (0, 1))
    seen = dr.lerp(near, far, part)
    behind = dr.select(known, seen, surface.chain.mean)
    shine = surface.specular * (_reflectance(surface, n, cosine) * seen)
    return dr.select(there, surface.diffuse * _matte(surface, normal, window) + shine, behind)


def _matte(surface: Surface, normal: Any, window: Any) -> Any:
    """Irradiance over π, of nine harmonics."""
    total = mi.Color3f(0)
    basis = harmonics(normal.x, normal.y, normal.z)
    for degree, share in ((0, 1.0), (1, 2 / 3), (2, 1 / 4)):  # the cosine's, over π
        factor = share / (1 + window * dr.square(degree * (degree + 1)))
        for index in range(degree * degree, (degree + 1) ** 2):
            total += surface.harmonics[index] * (basis[index] * factor)
    return dr.maximum(total, 0)


def _reflectance(surface: Surface, n: Any, cosine: Any) -> Any:
    """The share of light from everywhere that the lobe reflects, bilinear in its table."""
    stretch = (n + 1) / 8
    warped = cosine * dr.sqrt((1 + stretch) / (1 + stretch * dr.square(cosine)))
    x = dr.clip((warped + 1) * ((COLUMNS - 1) / 2), 0, COLUMNS - 1)
    y = dr.clip(dr.log2(n + 1) * 2, 0, ROWS - 1)
    column, row = dr.minimum(mi.UInt32(x), COLUMNS - 2), dr.minimum(mi.UInt32(y), ROWS - 2)
    right, down = x - mi.Float(column), y - mi.Float(row)
    corner = row * COLUMNS + column
    four = [
        dr.gather(mi.Float, surface.albedo, corner + extra)
        for extra in (0, 1, COLUMNS, COLUMNS + 1)
    ]
    upper, lower = (dr.lerp(four[k], four[k + 1], right) for k in (0, 2))
    return dr.maximum(dr.lerp(upper, lower, down) + dr.maximum(cosine, 0), 0)
