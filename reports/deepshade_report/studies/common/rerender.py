"""Views of a data set rendered again: with another size, field of view or effect radius."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from deepshade.camera import Camera
from deepshade.gbuffer.background import remove
from deepshade_report.view import View


def median_depth(view: View) -> float:
    """The median depth of what a view shows, scene units."""
    return float(np.median(-view.attributes["position"][2][~view.background]))


def rerendered(view: View, size: int, *, fov: float, radius: float, spp: int) -> View:
    """The whole frame of `view`'s camera, `size` pixels square, with a reference of its own.

    Raises SceneError where the scene can't be opened.
    """
    from deepshade_workers.records import view_of
    from deepshade_workers.render import render_sample

    scene = _opened(view.scene)
    camera = Camera(fov, size, size, view.camera.matrix)
    made = replace(view_of({**view.record, "radius": radius}, scene), camera=camera)
    effect = view.effect.name
    images = render_sample(
        scene, made, size, size, effects=[effect], samples=spp, seed=int(view.record["seed"])
    )
    reference, error = (images.pop(f"reference_{effect}{end}") for end in ("", "_error"))
    planes = {name: np.array(images[name]) for name in view.effect.inputs}
    background, _ = remove(planes, list(planes))
    return View(
        view.scene,
        view.effect,
        planes,
        background,
        reference,
        radius,
        camera,
        {**view.record, "radius": radius},
        error,
    )


@lru_cache(maxsize=16)
def _opened(name: str) -> Any:
    from deepshade_workers.backend import mitsuba
    from deepshade_workers.scenes.loading import open_scene

    mitsuba()
    return open_scene(name)
