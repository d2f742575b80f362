"""Samples for a mesh's perceptron: some pixels of a view, the normals around each, and its answer.

Erra et al. 2017 (see `deepshade.circles`) take 512 pixels of each of 128 views from a sphere
around the mesh.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import drjit as dr
import numpy as np

from deepshade import circles
from deepshade.camera import Camera
from deepshade.errors import SceneError
from deepshade_workers.attributes import make_attributes
from deepshade_workers.backend import mitsuba
from deepshade_workers.references import reference_of
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, trace
from deepshade_workers.view import Image, Images, View
from deepshade_workers.viewpoints import FOV

mi = mitsuba()

ATTRIBUTE = "normal_object"
# Of the mesh's diagonal: 17 % of the depth that it is seen at, in the middle of what shaders learn.
RADIUS_SHARE = 0.2


def view_around(scene: Scene, index: int, seed: int, size: int, radius: float | None) -> View:
    """View number `index` from a sphere around a scene, which the picture (`size`²) just holds.

    Any first few numbers lie evenly on the sphere (the golden ratio's sequence in two dimensions,
    M. Roberts 2018). `radius` None is `RADIUS_SHARE` of the diagonal.
    """
    start = np.random.default_rng(seed).random(2)
    u, v = (start + index * np.array([0.7548776662466927, 0.5698402909980532])) % 1
    up, around = 2 * v - 1, 2 * math.pi * u
    flat = math.sqrt(1 - up * up)
    toward = np.array([flat * math.cos(around), up, flat * math.sin(around)])
    middle = scene.bounds.mean(0)
    eye = middle + toward * scene.diagonal / 2 / math.sin(math.radians(FOV) / 2)
    camera = Camera.look_at(eye, middle, (0, 1, 0), FOV, size, size)
    return View(camera, scene.diagonal * RADIUS_SHARE if radius is None else radius)


def render_circles(
    scene: Scene,
    view: View,
    size: int,
    pixels: int,
    *,
    effects: Iterable[str],
    samples: int,
    seed: int,
) -> Images:
    """`pixels` random pixels of a view that show a surface, some twice where few do.

    "normal_object" (3, 16, pixels) are the normals around each, 0 where nothing is shown or past
    the picture's edge; `reference_<effect>` and its error (outputs, 1, pixels) the answers.

    Raises SceneError: the view shows nothing.
    """
    hits = trace(scene, view.camera, size, size)
    there = np.flatnonzero(hits.valid.numpy())
    if not len(there):
        raise SceneError(f"nothing of {scene.name} is seen", fix="check that it has some size")
    rng = np.random.default_rng(seed)
    chosen = rng.choice(there, pixels, replace=len(there) < pixels)
    normals = make_attributes(scene, view, hits, [ATTRIBUTE], seed=seed)[ATTRIBUTE]
    found: Images = {ATTRIBUTE: _around(normals, chosen, size)}
    few = _of(hits, chosen)
    for effect in effects:
        pair = reference_of(effect)(scene, view, few, {}, samples=samples, seed=seed)
        found[f"reference_{effect}"], found[f"reference_{effect}_error"] = pair
    return found


def _around(planes: Image, chosen: np.ndarray, size: int) -> Image:
    """(C, 16, n) what (C, H, W) holds around n pixels."""
    reach = circles.RADIUS
    wide = np.pad(planes, ((0, 0), (reach, reach), (reach, reach)))
    rows, columns = chosen // size + reach, chosen % size + reach
    return np.stack([wide[:, rows + y, columns + x] for x, y in circles.offsets()], 1)


def _of(hits: Hits, chosen: np.ndarray) -> Hits:
    """Some of the pixels, as a picture of one row."""
    index = mi.UInt32(chosen.astype(np.uint32))
    parts = {
        name: dr.gather(type(getattr(hits, name)), getattr(hits, name), index)
        for name in ("valid", "p", "ng", "ns", "depth", "back", "surface")
    }
    dr.eval(parts)
    return Hits(len(chosen), 1, **parts)
