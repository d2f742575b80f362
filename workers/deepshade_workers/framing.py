"""A camera for a scene of which nobody says where to look from: the one that sees most of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade_workers.backend import mitsuba
from deepshade_workers.scenes.mesh import Floats
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import eye_of, trace
from deepshade_workers.view import Vector

mi = mitsuba()

POINTS = 1024  # of the scene, which are looked for, twice
CELLS = 16  # along the longest side of the box: where points crowd they count less
# From outside: three quarters from the front first, seen from so far up (degrees).
AZIMUTHS = (30, -30, 60, -60, 120, -120, 150, -150)
ELEVATIONS = (20, 40)
# From inside: in corners of the box, at a height of it, in shares from its middle to its walls.
CORNERS = ((0.8, 0.8), (-0.8, 0.8), (0.8, -0.8), (-0.8, -0.8), (0, 0.85), (0, -0.85), (0.85, 0))
HEIGHTS = (0.45, 0.6)
# A later candidate must see so much more than an earlier one: the usual view wins draws.
BETTER = 1.05
# Surfaces seen from behind mean that the eye is in a wall, or that walls look inward.
MAX_BACK = 0.1
NEAR = 0.02  # of the scene's extent: nothing that fills the picture may be nearer


@dataclass(frozen=True)
class Framing:
    """Where to look from, and at what; `place` is "outside" or "inside", `seen` a share."""

    eye: Vector
    target: Vector
    place: str
    seen: float


def frame(scene: Scene, fov: float, width: int, height: int) -> Framing:
    """The candidate that sees surfaces in most of the scene's cells, y up.

    Candidates are three-quarter views of the whole from outside and views across it from inside;
    those that see much of surfaces' backs count last.
    """
    points = _surface_points(scene)
    low, high = _box(scene, points)
    points = points[((points >= low) & (points <= high)).all(1)]
    cells = _cells(points, low, high)
    best: tuple[bool, float, Framing] | None = None
    digits = 3 - int(np.floor(np.log10(np.linalg.norm(high - low))))
    for place, *ends in _candidates(points, low, high, fov, width / height):
        # Rounded first: what is printed makes the same view again.
        eye, target = (_vector(end, digits) for end in ends)
        camera = Camera.look_at(eye, target, (0, 1, 0), fov, width, height)
        seen, clear = _seen(scene, camera, points, cells)
        found = Framing(eye, target, place, round(seen, 3))
        if best is None or (clear, seen) > (best[0], best[1] * BETTER):
            best = clear, seen, found
    assert best is not None
    return best[2]


def _box(scene: Scene, points: Floats) -> tuple[Floats, Floats]:
    """The box of what is worth seeing: a town on a wide plain is as large as the town."""
    low, high = np.percentile(scene.points, [1, 99], axis=0)
    whole = scene.bounds[1] - scene.bounds[0]
    # Few triangles say little, and what is nearly all of the scene is all of it.
    tight = (high - low < 0.5 * whole) & (len(scene.points) >= POINTS // 4)
    low = np.where(tight, low, scene.bounds[0])
    high = np.where(tight, high, scene.bounds[1])
    inside = ((points >= low) & (points <= high)).all(1)
    return (low, high) if inside.any() else (scene.bounds[0], scene.bounds[1])


def _cells(points: Floats, low: Floats, high: Floats) -> NDArray[np.int64]:
    """The number of the cell that each point is in."""
    size = max(float((high - low).max()), 1e-30) / CELLS
    place = np.minimum((points - low) / size, CELLS - 1).astype(np.int64)
    return np.asarray(np.unique(place @ (CELLS**2, CELLS, 1), return_inverse=True)[1])


def _candidates(
    points: Floats, low: Floats, high: Floats, fov: float, aspect: float
) -> list[tuple[str, Floats, Floats]]:
    middle, half = (low + high) / 2, np.maximum(high - low, 1e-9) / 2
    slope = np.tan(np.radians(fov) / 2) * np.array([1, 1 / aspect])
    found: list[tuple[str, Floats, Floats]] = []
    for up in np.radians(ELEVATIONS):
        for around in np.radians(AZIMUTHS):
            toward = np.array(
                [np.sin(around) * np.cos(up), np.sin(up), np.cos(around) * np.cos(up)]
            )
            right = np.array([np.cos(around), 0, -np.sin(around)])
            # So far that all points fit: |across| <= slope (distance - along).
            offset = points - middle
            across = np.abs(offset @ np.stack([right, np.cross(toward, right)], 1))
            distance = float((offset @ toward + (across / slope).max(1)).max())
            found.append(("outside", middle + 1.05 * distance * toward, middle))
    for share in HEIGHTS:
        for x, z in CORNERS:
            eye = middle + half * (x, 2 * share - 1, z)
            found.append(("inside", eye, middle - half * (0.3 * x, 0.2, 0.3 * z)))
    return found


def _surface_points(scene: Scene) -> Floats:
    """(n, 3) places on surfaces: half where triangles are small, half evenly by area."""
    rng = np.random.default_rng(0)
    if scene.mesh is not None:
        corners = scene.mesh.vertices[scene.mesh.faces]
        edges = corners[:, 1:] - corners[:, :1]
        area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        chosen = corners[rng.choice(len(area), POINTS, p=area / area.sum())]
        weights = rng.dirichlet((1, 1, 1), POINTS)
        even = (weights[:, :, None] * chosen).sum(1)
        return np.concatenate([scene.points[:: max(1, len(scene.points) // POINTS)], even])
    toward = rng.normal(size=(3, POINTS))
    low, high = scene.bounds
    origin = (low + rng.random((POINTS, 3)) * (high - low)).T
    ray = mi.Ray3f(
        mi.Point3f(origin.astype(np.float32)),
        mi.Vector3f((toward / np.linalg.norm(toward, axis=0)).astype(np.float32)),
    )
    hit = scene.traced.ray_intersect(ray)
    found = np.asarray(hit.p.numpy().T[hit.is_valid().numpy()], np.float64)
    return found if len(found) else scene.points  # a plane: all rays from within it miss


def _seen(
    scene: Scene, camera: Camera, points: Floats, cells: NDArray[np.int64]
) -> tuple[float, bool]:
    """The share of `cells` with points in view; whether surfaces show their fronts, none near."""
    probe = trace(scene, replace(camera, width=48, height=32), 48, 32)
    valid = probe.valid.numpy()
    depth = probe.depth.numpy()[valid]
    if not len(depth):
        return 0.0, False
    clear = float(probe.back.numpy()[valid].mean()) <= MAX_BACK
    clear &= float(np.percentile(depth, 10)) > NEAR * scene.extent
    local = points @ camera.matrix[:3, :3].T + camera.matrix[:3, 3]
    ahead = -local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = np.abs(local[:, :2] / ahead[:, None]) * camera.pixels_per_unit * 2
    inside = (ahead > 0) & (across <= (camera.width, camera.height)).all(1)
    if not inside.any():
        return 0.0, clear
    offset = points[inside] - camera.eye
    length = np.linalg.norm(offset, axis=1)
    ray = mi.Ray3f(
        eye_of(camera),
        mi.Vector3f((offset / length[:, None]).T.astype(np.float32)),
        mi.Float((length * (1 - 1e-3)).astype(np.float32)),
        0.0,
        [],
    )
    open_way = ~scene.traced.ray_test(ray).numpy()
    return len(np.unique(cells[inside][open_way])) / (int(cells.max()) + 1), clear


def _vector(values: Floats, digits: int) -> Vector:
    x, y, z = (round(float(value), digits) for value in values)
    return x, y, z
