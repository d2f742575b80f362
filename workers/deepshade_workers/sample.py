"""Renders one view: its attributes and the references of the effects asked for."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from deepshade.camera import Camera
from deepshade_workers.references.ao import REFERENCES
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import Hits, attributes, trace

Images = dict[str, NDArray[np.float32]]


def render_sample(
    scene: Scene,
    camera: Camera,
    width: int,
    height: int,
    *,
    effects: Iterable[str],
    radius: float,
    samples: int,
    seed: int,
) -> tuple[Images, Hits]:
    """Trace the `width` x `height` window of `camera`: planar (C, H, W) float32 images.

    Keys are attribute names, `reference_<effect>` and `reference_<effect>_error`. `samples` are
    per pixel, rounded down to an even number; the same `seed` gives the same noise.
    """
    hits = trace(scene, camera, width, height)
    images = attributes(hits, camera)
    for effect in effects:
        value, error = REFERENCES[effect](scene, hits, radius=radius, samples=samples, seed=seed)
        images[f"reference_{effect}"] = value.reshape(-1, height, width)
        images[f"reference_{effect}_error"] = error.reshape(-1, height, width)
    return images, hits
