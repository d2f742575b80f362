"""Chooses cameras in a scene, as in the paper (section 4.2): random places in its box."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from deepshade.camera import Camera
from deepshade.effects import SETTINGS
from deepshade.errors import SceneError
from deepshade_workers.drawing import dress
from deepshade_workers.references import ao
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, trace
from deepshade_workers.view import MIN_CONTRAST, Limits, Vector, View

FOV = 50.0
PROBE = 48
MAX_TRIES = 400
MAX_BACKGROUND = 0.6
MAX_BACK_FACES = 0.05
# Effect radius relative to the view's median depth: about 25 to 280 pixels of a 512-pixel frame.
RADIUS_RANGE = SETTINGS["radius"].learnt


def sample_view(
    scene: Scene,
    rng: np.random.Generator,
    *,
    frame: int,
    size: int,
    radius: float | None = None,
    min_contrast: float = MIN_CONTRAST,
    displacements: Mapping[str, Vector] | None = None,
    limits: Limits | None = None,
) -> View:
    """A random view: `size`² pixels out of a `frame`² one, at a random place of it.

    Refused are views from inside geometry (back faces show), of mostly background, from so near
    that one surface fills the view, and those whose ambient occlusion varies by less than
    `min_contrast` (standard deviation), such as a bare wall. `radius` is drawn log-uniformly in
    `RADIUS_RANGE` times the median depth unless given. `displacements` become the view's.

    With `limits` a light, a lens, motions and a look are drawn too (`drawing.dress`), from a
    stream of their own: the view is the same without.

    Raises:
        SceneError: no such view turned up in `MAX_TRIES` tries.
    """
    for _ in range(MAX_TRIES):
        camera = _random_camera(scene, rng, frame, size)
        factor = float(np.exp(rng.uniform(*np.log(RADIUS_RANGE))))
        seed = int(rng.integers(2**63))
        if camera is None:
            continue
        probe = _shrunk(camera, size)
        hits = trace(scene, probe, PROBE, PROBE)
        depth = _usable_depth(scene, hits)
        if depth is None:
            continue
        reach = factor * depth if radius is None else radius
        view = View(camera, reach, displacements=displacements or {})
        visibility, _ = ao.reference(scene, view, hits, {}, samples=32, seed=seed)
        if float(visibility.std()) >= min_contrast:
            return view if limits is None else dress(scene, view, hits, rng.spawn(1)[0], limits)
    raise SceneError(
        f"no useful view of {scene.name} in {MAX_TRIES} tries",
        fix="check that its faces look outward and that its size suits --radius",
    )


def _random_camera(scene: Scene, rng: np.random.Generator, frame: int, size: int) -> Camera | None:
    """Four in ten eyes lie anywhere in the scene's box, the others near what they look at."""
    low, high = scene.bounds
    target = scene.points[rng.integers(len(scene.points))]
    direction = rng.normal(size=3)
    direction *= np.array([1, 0.5, 1]) / np.linalg.norm(direction)
    distance = scene.extent * float(np.exp(rng.uniform(np.log(0.06), np.log(0.8))))
    anywhere = rng.uniform(low, high)
    eye = anywhere if rng.random() < 0.4 else target + direction * distance
    x0, y0 = (int(v) for v in rng.integers(0, frame - size + 1, 2))
    slack = 0.15 * (high - low)
    if not ((eye >= low - slack) & (eye <= high + slack)).all() or np.allclose(eye, target):
        return None
    return replace(Camera.look_at(eye, target, (0, 1, 0), FOV, frame, frame), x0=x0, y0=y0)


def _shrunk(camera: Camera, size: int) -> Camera:
    """The same window seen with `PROBE`² pixels: the window's own narrower, shifted camera."""
    plane = 1 / camera.pixels_per_unit  # one pixel's width at distance 1
    cx = (camera.x0 + size / 2 - camera.width / 2) * plane
    cy = (camera.height / 2 - camera.y0 - size / 2) * plane
    fov = float(np.degrees(2 * np.arctan(size * plane / 2)))
    return Camera(fov, PROBE, PROBE, camera.matrix, center=(cx, cy))


def _usable_depth(scene: Scene, hits: Hits) -> float | None:
    """The median depth; None for views to refuse before any occlusion is rendered."""
    valid = hits.valid.numpy()
    if valid.mean() < 1 - MAX_BACKGROUND:
        return None
    if hits.back.numpy()[valid].mean() > MAX_BACK_FACES:
        return None
    depth = hits.depth.numpy()[valid]
    return float(np.median(depth)) if np.percentile(depth, 2) >= 0.002 * scene.extent else None
