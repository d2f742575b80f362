"""Light, lens, motions and a look, drawn for a view of a data set.

The ranges are those that users will set, in pixels of the picture. What is drawn depends on what a
coarse picture of the view shows, so every draw is recorded (`records`), not only its seed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import rotation_of
from deepshade.gbuffer.derivation import circle_of_confusion
from deepshade_workers.backend import mitsuba
from deepshade_workers.look import Look, scattering
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, material, offset_origin
from deepshade_workers.view import Light, Limits, LookRecord, Vector, View

mi = mitsuba()

Floats = NDArray[np.float64]
Rng = np.random.Generator

# How many views keep the materials of the scene's own file or family.
OWN_SHARE = 0.3
# The lamp's place: tries, and its distance from a visible point by the median depth.
LAMPS = 8
LAMP_DISTANCES = (0.3, 3.0)
# Irradiance (median over what the lamp lights) and the sky's radiance.
IRRADIANCES = (0.5, 4.0)
HOTSPOT = 10.0  # what is nearest to the lamp gets at most about so many times that
SKIES = (0.02, 1.5)
DARK_SKIES = 0.12  # the share of views whose sky is nearly black
LEAST_PIXELS = 2.0  # of the blur and of motions that there are
FREE = 0.6  # how much of the space about the eye lens and motions may take
DIRECTIONS = 128


def dress(scene: Scene, view: View, hits: Hits, rng: Rng, limits: Limits) -> View:
    """The view with a light, lens, motions and maybe a look, drawn from `rng`.

    `hits` are what a coarse picture of the same window sees. Motions that the view already has
    stay.
    """
    valid = hits.valid.numpy()
    depth = np.where(valid, hits.depth.numpy().astype(np.float64), np.inf)
    median = float(np.median(depth[valid]))
    space = FREE * _space(scene, view)
    depths = _depths(scene, view, hits, depth)
    focus, aperture = _lens(rng, view, depth, limits.max_blur, 2 * space)
    moving = dict(view.displacements) or _motions(
        rng, scene, view, depths, median, limits.max_motion, 2 * space
    )
    light = _light(rng, scene, hits, median)
    seed = int(rng.integers(2**63))
    own = bool(rng.random() < OWN_SHARE)
    nearest = {name: float(np.median(found)) for name, found in depths.items()}
    scatter = scattering(rng, nearest, view.camera.pixels_per_unit, limits.max_scatter)
    record = LookRecord(seed, median, limits.textures, scatter, own)
    return replace(
        view,
        focus=focus,
        aperture=aperture,
        shutter=1.0,
        displacements=moving,
        light=light,
        look=Look.draw(scene, view.camera, record) if scene.objects else None,
    )


def _space(scene: Scene, view: View) -> float:
    """The distance from the eye to what is nearest to it."""
    return float(_distances(scene, np.asarray(view.camera.eye)[:, None]).min())


def _distances(scene: Scene, places: Floats) -> Floats:
    """(n, DIRECTIONS): distances to the scene from `places` (3, n) in all directions."""
    # A Fibonacci lattice on the sphere (Swinbank and Purser, 2006).
    k = np.arange(DIRECTIONS)
    z = 1 - (2 * k + 1) / DIRECTIONS
    turn = k * np.pi * (3 - np.sqrt(5))
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(turn), z, np.sqrt(1 - z * z) * np.sin(turn)])
    count = places.shape[1]
    ray = mi.Ray3f(
        mi.Point3f(np.repeat(places, DIRECTIONS, 1).astype(np.float32)),
        mi.Vector3f(np.tile(sphere, count).astype(np.float32)),
    )
    distance = scene.traced.ray_intersect_preliminary(ray).t.numpy()
    return np.asarray(distance, np.float64).reshape(count, DIRECTIONS)


def _depths(scene: Scene, view: View, hits: Hits, depth: Floats) -> dict[str, Floats]:
    """The depths at which each visible object is seen, by its name."""
    valid = np.isfinite(depth)
    number = material(scene, view, hits.surface, hits.valid, "object", 1).numpy().astype(int)
    return {
        scene.objects[k].name: depth[valid & (number == k)]
        for k in np.unique(number[valid]).tolist()
        if k < len(scene.objects)
    }


def _uniform_log(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(max(low, high)))))


def _lens(rng: Rng, view: View, depth: Floats, most: float, widest: float) -> tuple[float, float]:
    """Focus on (or off) a visible point; 95 % of the picture is blurred by at most a drawn size."""
    focus = float(rng.choice(depth[np.isfinite(depth)]))
    if rng.random() < 0.2:
        focus *= _uniform_log(rng, 0.6, 2.5)
    blur = _uniform_log(rng, LEAST_PIXELS, most)
    unit = circle_of_confusion(depth.astype(np.float32), focus, 1.0, view.camera.pixels_per_unit)
    reach = float(np.percentile(np.abs(unit), 95))
    return focus, min(blur / max(reach, 1e-30), widest)


def _motions(
    rng: Rng,
    scene: Scene,
    view: View,
    depths: dict[str, Floats],
    median: float,
    most: float,
    farthest: float,
) -> dict[str, Vector]:
    """Motions parallel to the image plane: of some objects, or a common one and others.

    A motion's length in pixels holds at the object's near parts; no half of it goes beyond the
    free space about the eye, so that nothing moves through the camera.
    """
    right, up, _ = rotation_of(view.camera.matrix)
    unit = median / view.camera.pixels_per_unit

    def motion(pixels: float, angle: float, size: float) -> Vector:
        length = min(pixels * size, farthest)
        x, y, z = (length * (np.cos(angle) * right + np.sin(angle) * up)).tolist()
        return x, y, z

    found: dict[str, Vector] = {}
    near = {name: float(np.percentile(seen, 10)) for name, seen in depths.items()}
    if rng.random() < 0.3:  # a panning camera: everything moves alike on the screen
        pixels, angle = _uniform_log(rng, LEAST_PIXELS, most), float(rng.uniform(0, 2 * np.pi))
        for item in scene.objects:
            size = near[item.name] / view.camera.pixels_per_unit if item.name in near else unit
            found[item.name] = motion(pixels, angle, size)
    share = rng.uniform(0.1, 1) if not found else 0.2
    names = list(near)
    sure = names[int(rng.integers(len(names)))] if names and not found else None
    for name in names:
        chosen = rng.random() < share or name == sure
        pixels, angle = _uniform_log(rng, LEAST_PIXELS, most), float(rng.uniform(0, 2 * np.pi))
        if chosen:
            found[name] = motion(pixels, angle, near[name] / view.camera.pixels_per_unit)
    return found


def _light(rng: Rng, scene: Scene, hits: Hits, median: float) -> Light:
    """A lamp that lights something visible, and a sky."""
    position, cosines, clear = _lamp_place(rng, scene, hits, median)
    # Surfaces that it lights receive cosine / distance² times its intensity.
    typical = 1 / median**2
    if len(cosines):
        middle, near = np.percentile(cosines, [50, 95])
        typical = float(max(middle, near / HOTSPOT))
    strength = _uniform_log(rng, *IRRADIANCES) / typical
    size = 0.0 if rng.random() < 0.4 else min(_uniform_log(rng, 0.005, 0.1) * median, clear / 2)
    x, y, z = position.tolist()
    dark = rng.random() < DARK_SKIES
    level = 0.0 if rng.random() < 0.3 else 0.01
    brightness = level if dark else _uniform_log(rng, *SKIES)
    zenith, horizon, ground = (
        _coloured(rng, brightness * _uniform_log(rng, *span))
        for span in ((0.4, 1.2), (0.6, 2.0), (0.1, 0.8))
    )
    return Light((x, y, z), size, _coloured(rng, strength), zenith, horizon, ground)


def _coloured(rng: Rng, brightness: float) -> Vector:
    """`brightness` times a pale colour whose largest channel is 1; mostly warm or cool."""
    warmth, tint = rng.uniform(-0.25, 0.25), rng.uniform(-0.06, 0.06)
    colour = np.array([1 + warmth, 1 + tint, 1 - warmth])
    r, g, b = (brightness * colour / colour.max()).tolist()
    return r, g, b


def _lamp_place(rng: Rng, scene: Scene, hits: Hits, median: float) -> tuple[Floats, Floats, float]:
    """A place in the open that lights much of what is seen, how strongly, and the space about it.

    Places lie along free rays from visible points, so none is within geometry; of `LAMPS` tries
    one of those that light the most is taken.
    """
    valid = hits.valid.numpy()
    points, normals = (a.numpy()[:, valid].astype(np.float64) for a in (hits.p, hits.ng))
    chosen = rng.integers(points.shape[1], size=LAMPS)
    start, side = points[:, chosen], normals[:, chosen]
    ways = rng.normal(size=(3, LAMPS))
    ways = side + 0.95 * ways / np.linalg.norm(ways, axis=0)
    ways /= np.linalg.norm(ways, axis=0)
    origin = offset_origin(_points(start), _vectors(side), scene)
    free = scene.traced.ray_intersect_preliminary(mi.Ray3f(origin, _vectors(ways))).t.numpy()
    wanted = median * np.exp(
        rng.uniform(np.log(LAMP_DISTANCES[0]), np.log(LAMP_DISTANCES[1]), LAMPS)
    )
    places = start + ways * np.minimum(wanted, 0.7 * free)
    count = points.shape[1]
    tries = np.repeat(places, count, 1)
    toward = tries - np.tile(points, LAMPS)
    distance = np.maximum(np.linalg.norm(toward, axis=0), 1e-30)
    cosine = (toward * np.tile(normals, LAMPS)).sum(0) / distance
    origin = offset_origin(
        _points(np.tile(points, LAMPS)), _vectors(np.tile(normals, LAMPS)), scene
    )
    ray = mi.Ray3f(origin, _vectors(toward / distance), mi.Float(distance * 0.999), 0.0, [])
    lit = ~scene.traced.ray_test(ray).numpy() & (cosine > 0)
    lit = lit.reshape(LAMPS, count)
    share = lit.mean(1) * rng.uniform(0.5, 1, LAMPS)
    best = int(share.argmax())
    received = (cosine / distance**2).reshape(LAMPS, count)[best, lit[best]]
    clear = float(_distances(scene, places[:, best : best + 1]).min())
    return places[:, best], received, clear


def _points(values: Floats) -> Any:
    return mi.Point3f(values.astype(np.float32))


def _vectors(values: Floats) -> Any:
    return mi.Vector3f(values.astype(np.float32))
