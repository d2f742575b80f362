"""Subsurface scattering: normalised diffusion over what the camera sees."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from deepshade.camera import rotation_of
from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair, strata
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits
from deepshade_workers.view import Image, Images, View

mi = mitsuba()

# Streams of other references must not repeat here.
STREAM = 0x73636174
# Cosine between a surface and the view at which footprints stop growing: they would reach beyond
# the edges of what is round. Of a sphere only the last 1.8 degrees count less.
GRAZING = 1 / 32
# Least mean free path, pixels: at a thousandth all light leaves the pixel that it enters.
LEAST = 1e-3
# Pixels about each whose footprints are integrated over their outline, the others by sampling.
NEAR = 1
# Points of the quadrature along each edge of an outline.
EDGE_POINTS = 8


def reference(
    scene: Scene, view: View, hits: Hits, images: Images, *, samples: int, seed: int
) -> tuple[Image, Image]:
    """Σ_j a_j R(|P_i - P_j|) L_j / Σ_j a_j R(|P_i - P_j|) over all visible pixels that scatter.

    Normalised diffusion R(r) = (exp(-r/d) + exp(-r/3d)) / (8π d r) with the receiver's mean free
    path d of each channel (Christensen and Burley, "Approximate Reflectance Profiles for Efficient
    Subsurface Scattering", 2015). Each pixel's part is the integral of R over its footprint: the
    parallelogram, in the plane that touches its surface, which its sides project to. The nearest
    are integrated along their outlines, for R is singular at the receiver; the others by two
    jittered samples in each of `samples`/2 strata of the picture about the receiver, spread as R
    is. Both sums are unbiased, and each pair's difference gives an unbiased variance.

    `images` holds "position", "scatter" and "light", all (3, H, W). Returns (3, H, W) radiance and
    its standard error; L and 0 in the background and where a channel doesn't scatter.
    """
    value, error = _diffuse(view, hits, images, samples, seed)
    light = images["light"]
    scatters = (images["scatter"] > 0) & hits.valid.numpy().reshape(1, hits.height, hits.width)
    return np.where(scatters, light + value, light), np.where(scatters, error, np.float32(0))


def profile(r: Any, d: Any) -> Any:
    """R(r), per unit of area, of Dr.Jit numbers r > 0 and d > 0 of one unit of length."""
    return (dr.exp(-r / d) + dr.exp(-r / (3 * d))) / (8 * dr.pi * d * r)


def within(r: Any, d: Any) -> Any:
    """Share of the light that leaves within the distance r: the integral of R over that disc."""
    return 1 - 0.25 * dr.exp(-r / d) - 0.75 * dr.exp(-r / (3 * d))


def footprints(view: View, hits: Hits, position: Image) -> tuple[Image, Image]:
    """What a step of one pixel right and one down moves a point of each surface, (3, H, W) both."""
    camera = view.camera
    rays = camera.rays(hits.width, hits.height).astype(np.float64)
    normal = rotation_of(camera.matrix) @ hits.ng.numpy().astype(np.float64)
    normal = normal.reshape(rays.shape)
    # With the ray q per unit of depth, P = q (n·P)/(n·q), and so ∂P = depth (∂q - q (n·∂q)/(n·q)).
    least = GRAZING * np.linalg.norm(rays, axis=0)
    across = -np.maximum(-(normal * rays).sum(0), least)
    depth = -position[2].astype(np.float64)
    pitch = 1 / camera.pixels_per_unit
    sides = []
    for axis, step in ((0, pitch), (1, -pitch / camera.pixel_aspect)):
        side = -rays * normal[axis] / across
        side[axis] += 1
        sides.append((depth * step * side).astype(np.float32))
    return sides[0], sides[1]


@dr.syntax
def _diffuse(
    view: View, hits: Hits, images: Images, samples: int, seed: int
) -> tuple[Image, Image]:
    """What diffusion adds to L, and its standard error, where a channel scatters."""
    width, height = hits.width, hits.height
    valid = hits.valid.numpy().reshape(height, width)
    position = np.where(valid, images["position"], 0)
    right, down = (np.where(valid, side, 0) for side in footprints(view, hits, position))
    scatter = np.where(valid, images["scatter"], 0)
    points, rights, downs = (_points(image) for image in (position, right, down))
    masks, lights = _points(scatter > 0), _points(images["light"])

    # Opaque: a kernel serves all views.
    wide, high = (dr.opaque(mi.Int32, n) for n in (width, height))
    aspect = dr.opaque(mi.Float, view.camera.pixel_aspect)
    pixel = dr.arange(mi.UInt32, width * height)
    column = mi.Float(mi.Int32(pixel) % wide) + 0.5
    row = mi.Float(mi.Int32(pixel) // wide) + 0.5
    here = dr.gather(mi.Point3f, points, pixel)
    own = dr.gather(mi.Color3f, lights, pixel)
    # Lengths in pixels at the receiver's depth, so that nothing over- or underflows.
    scale = dr.opaque(mi.Float, view.camera.pixels_per_unit) / dr.maximum(-here.z, 1e-30)
    path = dr.maximum(mi.Color3f(*map(_flat, scatter)) * scale, LEAST)
    active = dr.any(mi.Color3f(*map(_flat, scatter)) > 0)

    def other(x: Any, y: Any) -> tuple[Any, ...]:
        """The pixel of column x, row y, where there is one that counts, as seen from here."""
        inside = active & (x >= 0) & (x < wide) & (y >= 0) & (y < high)
        index = mi.UInt32(dr.select(inside, y * wide + x, 0))
        mask = dr.gather(mi.Color3f, masks, index, inside)
        brighter = dr.gather(mi.Color3f, lights, index, inside) - own
        away = (dr.gather(mi.Point3f, points, index, inside) - here) * scale
        u = dr.gather(mi.Vector3f, rights, index, inside) * scale
        v = dr.gather(mi.Vector3f, downs, index, inside) * scale
        return inside & dr.any(mask > 0), mask, brighter, mi.Vector3f(away), u, v

    side = 2 * NEAR + 1
    cells = dr.opaque(mi.Int32, side * side)
    cell = mi.Int32(0)
    near = mi.Color3f(0)
    near_light = mi.Color3f(0)
    while cell < cells:
        x = mi.Int32(column) + cell % side - NEAR
        y = mi.Int32(row) + cell // side - NEAR
        there, mask, brighter, away, u, v = other(x, y)
        share = dr.select(there, mask * over_outline(away, u, v, path), 0)
        near += share
        near_light += share * brighter
        cell += 1

    # Distances spread as s / (r + s)^2 from where the nearest end to the farthest corner of the
    # picture: with s twice the mean free path nearly as R(r) r does, whose samples then have nearly
    # equal weights.
    spread = 2 * dr.mean(path)
    farthest = mi.Vector2f(dr.maximum(column, wide - column), dr.maximum(row, high - row) / aspect)
    begin = (NEAR + 0.5) * dr.minimum(1, 1 / aspect)
    reach = dr.maximum(dr.norm(farthest), 2 * begin)
    inner = begin / (begin + spread)
    covered = reach / (reach + spread) - inner
    stream = pixel_streams(width * height, seed ^ STREAM)
    columns, rows = strata(samples)
    across, count = dr.opaque(mi.UInt32, columns), dr.opaque(mi.UInt32, columns * rows)
    size = mi.Point2f(mi.Float(across), mi.Float(dr.opaque(mi.UInt32, rows)))

    def far(stratum: Any, index: Any) -> tuple[Any, Any]:
        random = (stratum + random_pair(stream, index)) / size
        share = dr.fma(random.x, covered, inner)
        r = spread * share / (1 - share)
        sine, cosine = dr.sincos(dr.two_pi * random.y)
        at_x, at_y = column + r * cosine, row + r * sine * aspect
        x, y = mi.Int32(dr.floor(at_x)), mi.Int32(dr.floor(at_y))
        there, mask, brighter, away, u, v = other(x, y)
        off = dr.maximum(dr.abs(x - mi.Int32(column)), dr.abs(y - mi.Int32(row)))
        there &= off > NEAR
        # The sample stands for its own place on the footprint.
        away += (at_x - mi.Float(x) - 0.5) * u + (at_y - mi.Float(y) - 0.5) * v
        density = spread / (dr.square(r + spread) * covered * dr.two_pi * r * aspect)
        area = dr.norm(dr.cross(u, v))
        share = mask * profile(dr.maximum(dr.norm(away), 1e-6), path) * area / density
        share = dr.select(there, share, 0)
        return share, share * brighter

    k = mi.UInt32(0)
    total = mi.Color3f(0)
    total_light = mi.Color3f(0)
    square = mi.Color3f(0)
    cross = mi.Color3f(0)
    light_square = mi.Color3f(0)
    while k < count:
        stratum = mi.Point2f(mi.Float(k % across), mi.Float(k // across))
        first, first_light = far(stratum, 2 * k)
        second, second_light = far(stratum, 2 * k + 1)
        total += first + second
        total_light += first_light + second_light
        square += dr.square(first - second)
        cross += (first - second) * (first_light - second_light)
        light_square += dr.square(first_light - second_light)
        k += 1

    used = 2 * mi.Float(count)
    weight = near + total / used
    value = (near_light + total_light / used) / weight
    # The variance of a ratio of sums, to the first order.
    variance = light_square - 2 * value * cross + dr.square(value) * square
    error = dr.sqrt(dr.maximum(variance, 0)) / (used * weight)
    dr.eval(value, error)  # in one kernel
    return hits.planar(value), hits.planar(error)


def over_outline(away: Any, u: Any, v: Any, path: Any) -> Any:
    """Integral of R from the origin over the parallelogram away ± u/2 ± v/2, a channel each.

    `away`, `u` and `v` are 3-D, `path` holds the channels' mean free paths. About the foot of the
    origin on the plane, at the height z, ∫∫ R ρ dρ dφ = ∫ (C(r) - C(z)) dφ / 2π along the outline,
    where C is `within` and r the distance from the origin: no singularity is left.
    """
    normal = dr.normalize(dr.cross(u, v))
    height = dr.dot(away, normal)
    foot = normal * height
    below = within(dr.abs(height), path)
    corners = [
        away + x * u + y * v - foot for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    ]
    nodes, weights = np.polynomial.legendre.leggauss(EDGE_POINTS)
    total = mi.Color3f(0)
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        along = dr.normalize(end - start)
        # Signed distance of the edge's line from the foot: positive with the foot on its left.
        signed = dr.dot(normal, dr.cross(start, along))
        distance = dr.maximum(dr.abs(signed), 1e-6)
        # Along the edge distance · sinh w, where dφ = dw / cosh w: smooth even past long edges.
        low = dr.asinh(dr.dot(start, along) / distance)
        high = dr.asinh(dr.dot(end, along) / distance)
        part = mi.Color3f(0)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            stretch = dr.cosh(dr.lerp(low, high, (node + 1) / 2))
            r = dr.sqrt(dr.square(distance * stretch) + dr.square(height))
            part += weight * (within(r, path) - below) / stretch
        part *= (high - low) / 2
        total += dr.select(signed < 0, -part, part)
    return total * dr.inv_two_pi


def _points(image: Any) -> Any:
    """A (3, H, W) image as a buffer to gather points from."""
    return mi.Float(np.ascontiguousarray(image.reshape(3, -1).T, np.float32).ravel())


def _flat(plane: Any) -> Any:
    return mi.Float(np.ascontiguousarray(plane, np.float32).ravel())
