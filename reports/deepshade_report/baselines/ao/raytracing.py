"""Ambient occlusion by a few rays a pixel: what one does who has the geometry at hand.

The scene and camera are rebuilt from the view's record and traced as the references were, with
the same estimator but independent random numbers; Open Image Denoise takes the noise out. The
G-buffer is given, as it is to every method, so primary hits aren't part of what is timed.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba_oidn as oidn
import numpy as np

from deepshade.errors import DataError
from deepshade_report.view import Float, View
from deepshade_workers.backend import mitsuba
from deepshade_workers.sampling import pixel_streams, random_pair, strata
from deepshade_workers.scenes.loading import open_scene
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


@lru_cache(maxsize=1)  # several methods shade each view in turn
def rebuild(view: View) -> tuple[Scene, Hits]:
    """The scene that a view was rendered from, and what its pixels' centres see.

    Raises:
        DataError: the scene is no longer what it was.
        SceneError: there is no such scene.
    """
    scene = open_scene(view.scene)
    hits = trace(scene, view.camera, view.width, view.height)
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
    return scene, hits


def denoise(noisy: Float, normal: Float, quality: str) -> Float:
    """(H, W) without the noise, by Open Image Denoise; may leave [0, 1] by a little.

    `normal` is (H, W, 3), unit, zero in background. The noise of a few rays a pixel is clipped to
    [0, 1], and the filter's mode for pictures of low dynamic range takes it for that of a brighter,
    clipped signal: at 4 rays a pixel its answer is .03 to .05 too bright on average. Its mode for
    high dynamic range keeps the mean, so that one runs, with a scale of 1 rather than one guessed
    from the picture.
    """
    clean = oidn.denoise(
        noisy,
        albedo=np.ones_like(normal),  # the filter wants one with every normal
        normal=normal,
        hdr=True,
        input_scale=1.0,
        clean_aux=True,  # primary hits through pixel centres have no noise
        quality=_QUALITIES[quality],
    )
    return np.asarray(clean, np.float32)


class RayTracing:
    """Mitsuba's rays, denoised at "fast" or "high" quality, or left as they are."""

    family = "ray tracing"
    needs_scene = True

    def __init__(self, rays: int, quality: str | None = None) -> None:
        self.rays, self.quality = rays, quality
        self.name = "Mitsuba + OIDN" if quality else "Mitsuba"
        self.settings: dict[str, Any] = {"spp": rays} | ({"quality": quality} if quality else {})
        self._normal = np.empty((0, 0, 3), np.float32)

    def prepare(self, view: View) -> None:
        """Rebuild the scene and find the primary hits.

        Raises DataError or SceneError where the view's scene isn't to be had.
        """
        rebuild(view)
        self._normal = np.ascontiguousarray(view.attributes["normal"].transpose(1, 2, 0))

    def shade(self, view: View) -> Float:
        """(H, W) in [0, 1] of the prepared view."""
        scene, hits = rebuild(view)
        seed = (int(view.record.get("seed", 0)) + _OTHER_SEED) % 2**64
        image = visibility(scene, hits, radius=view.radius, rays=self.rays, seed=seed)
        if self.quality is None:
            return image
        clean: Float = np.clip(denoise(image, self._normal, self.quality), 0, 1)
        return clean


def methods(quick: bool) -> list[RayTracing]:
    """Every number of rays, without a denoiser and with it; in a quick report, few.

    Of the denoiser's qualities the quickest and the best: the third lies between them.
    """
    counts = QUICK_RAYS if quick else RAYS
    return [RayTracing(rays, quality) for quality in (None, *_QUALITIES) for rays in counts]
