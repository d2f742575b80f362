"""Ambient occlusion by a few rays a pixel: what one does who has the geometry at hand.

The scene and camera are rebuilt from the view's record and traced as the references were, with
the same estimator but independent random numbers; Open Image Denoise takes the noise out. The
G-buffer is given, as it is to every method, so primary hits aren't part of what is timed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba_oidn as oidn
import numpy as np

from deepshade.errors import DataError, SceneError
from deepshade_report.method import Method
from deepshade_report.view import Float, View
from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair, strata
from deepshade_workers.scenes.loading import PROCEDURAL, open_scene
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, offset_origin, trace

mi = mitsuba()

RAYS = (1, 2, 4, 8)
QUICK_RAYS = (4,)
_QUALITIES = {"fast": oidn.Quality.Fast, "high": oidn.Quality.High}

# Added to the reference's seed: all its random numbers are hashed from that, so none recur.
_OTHER_SEED = 0x9E3779B97F4A7C15
# How far a depth may be from the stored one, relatively, and how many pixels may be farther.
_SAME_DEPTH = 1e-3
_MAX_DIFFERENT = 0.01


# The view that was rebuilt last: several methods shade each in turn.
_kept: tuple[View, Scene, Hits] | None = None


@dr.syntax
def visibility(scene: Scene, hits: Hits, *, radius: float, rays: int, seed: int) -> Float:
    """(H, W) share of `rays` directions that nothing blocks within `radius`; 1 in background.

    The references' estimator with one jittered, cosine-weighted direction in each stratum instead
    of two: two also tell the error, one has less of it. `rays` is rounded as `strata` does.
    """
    columns, rows = strata(2 * rays)
    stream = pixel_streams(len(hits.valid), seed)
    origin = offset_origin(hits.p, hits.ng, scene)
    frame = mi.Frame3f(hits.ns)
    # opaque: the compiled kernel is then the same for every scene and number of rays
    reach = dr.opaque(mi.Float, radius)
    wide = dr.opaque(mi.UInt32, columns)
    count = dr.opaque(mi.UInt32, columns * rows)
    size = mi.Point2f(mi.Float(wide), mi.Float(dr.opaque(mi.UInt32, rows)))
    traced, valid = scene.traced, hits.valid

    cell = mi.UInt32(0)
    total = mi.UInt32(0)
    while cell < count:
        corner = mi.Point2f(mi.Float(cell % wide), mi.Float(cell // wide))
        local = mi.warp.square_to_cosine_hemisphere((corner + random_pair(stream, cell)) / size)
        ray = mi.Ray3f(origin, frame.to_world(local), reach, 0.0, [])
        total += dr.select(traced.ray_test(ray, valid), mi.UInt32(0), mi.UInt32(1))
        cell += 1

    shares = dr.select(valid, mi.Float(total) / mi.Float(count), 1)
    return np.asarray(shares.numpy(), np.float32).reshape(hits.height, hits.width)


def rebuild(view: View) -> tuple[Scene, Hits]:
    """The scene that a view was rendered from, and what its pixels' centres see.

    Raises:
        DataError: the view names no scene or camera, or the scene is no longer what it was.
        SceneError: there is no such scene.
    """
    global _kept
    if _kept is not None and _kept[0] is view:
        return _kept[1:]
    scene = open_scene(find_scene(view.scene))
    hits = trace(scene, view.camera(), view.width, view.height)
    valid = hits.valid.numpy().reshape(view.height, view.width)
    depth = hits.depth.numpy().reshape(view.height, view.width)
    stored = -view.attributes["position"][2]
    same = valid == ~view.background
    same &= view.background | (np.abs(depth - stored) <= _SAME_DEPTH * stored)
    if 1 - same.mean() > _MAX_DIFFERENT:
        raise DataError(
            f"{1 - same.mean():.0%} of the view's pixels see another surface in {view.scene}",
            fix="use the scene file that the data set was rendered from",
        )
    _kept = view, scene, hits
    return scene, hits


def find_scene(name: str) -> str:
    """Where the scene of a record is: as it's named, or so below this folder or one around it.

    Data sets name files relative to where they were made, maybe in a folder beside that: of
    ../shared/scenes/a.obj, shared/scenes/a.obj is looked for here and in all folders above.

    Raises SceneError when it is nowhere.
    """
    if name.split(":")[0] == PROCEDURAL or Path(name).is_file():
        return name
    inner = Path(*(part for part in Path(name).parts if part not in ("..", "/")))
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / inner).is_file():
            return str(folder / inner)
    raise SceneError(
        f"the scene {name} isn't here",
        fix="run this in the folder that the data set was rendered in",
    )


class Denoiser:
    """The library's RT filter at "fast" or "high" quality, for one channel in [0, 1].

    The noise of a few rays a pixel is clipped to [0, 1], and the filter's mode for pictures of
    low dynamic range takes it for that of a brighter, clipped signal: at 4 rays a pixel its answer
    is .03 to .05 too bright on average. Its mode for high dynamic range keeps the mean, so that
    one runs, with a scale of 1 rather than one guessed from the picture.
    """

    def __init__(self, quality: str) -> None:
        self.quality = quality
        self._shape = (0, 0)
        self._normal = self._albedo = np.empty((0, 0, 3), np.float32)

    def prepare(self, normal: Float) -> None:
        """Take the (3, H, W) unit normals, zero in background, and build the filter.

        The filter wants an albedo with every normal: occlusion has none, so it's white.
        """
        self._normal = np.ascontiguousarray(normal.transpose(1, 2, 0), np.float32)
        self._albedo = np.ones_like(self._normal)
        shape = (normal.shape[1], normal.shape[2])
        if shape != self._shape:
            self._shape = shape
            self.denoise(np.ones(shape, np.float32))

    def denoise(self, noisy: Float) -> Float:
        """(H, W) without the noise; may leave [0, 1] by a little."""
        clean = oidn.denoise(
            noisy,
            albedo=self._albedo,
            normal=self._normal,
            hdr=True,
            input_scale=1.0,
            clean_aux=True,  # primary hits through pixel centres have no noise
            quality=_QUALITIES[self.quality],
        )
        return np.asarray(clean, np.float32)


class RayTracing:
    """Mitsuba's rays, denoised at "fast" or "high" quality, or left as they are."""

    family = "ray tracing"
    needs_scene = True

    def __init__(self, rays: int, quality: str | None = None) -> None:
        self.rays = rays
        self.name = "Mitsuba + OIDN" if quality else "Mitsuba"
        self.settings: dict[str, Any] = {"spp": rays} | ({"quality": quality} if quality else {})
        self._denoiser = Denoiser(quality) if quality else None
        self._ready: tuple[View, Scene, Hits] | None = None

    def prepare(self, view: View) -> None:
        """Rebuild the scene, find the primary hits, compile the kernel, build the filter.

        Raises DataError or SceneError where the view's scene isn't to be had.
        """
        scene, hits = rebuild(view)
        self._ready = view, scene, hits
        visibility(scene, hits, radius=view.radius, rays=1, seed=0)
        if self._denoiser:
            self._denoiser.prepare(view.attributes["normal"])

    def shade(self, view: View) -> Float:
        """(H, W) in [0, 1] of the prepared view."""
        if self._ready is None or self._ready[0] is not view:
            self.prepare(view)
        assert self._ready is not None
        _, scene, hits = self._ready
        seed = (int(view.record.get("seed", 0)) + _OTHER_SEED) % 2**64
        image = visibility(scene, hits, radius=view.radius, rays=self.rays, seed=seed)
        return np.clip(self._denoiser.denoise(image), 0, 1) if self._denoiser else image


def methods(quick: bool) -> Sequence[Method]:
    """Every number of rays, without a denoiser and with it; in a quick report, few.

    Of the denoiser's qualities the quickest and the best: the third lies between them.
    """
    counts = QUICK_RAYS if quick else RAYS
    return [RayTracing(rays, quality) for quality in (None, *_QUALITIES) for rays in counts]
