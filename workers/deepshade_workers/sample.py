"""Renders one view: the attributes and references asked for."""

from __future__ import annotations

from collections.abc import Iterable

from deepshade.effects import EFFECTS
from deepshade_workers.attributes import make_attributes
from deepshade_workers.references import reference_of
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace
from deepshade_workers.view import Images, View


def render_sample(
    scene: Scene,
    view: View,
    width: int,
    height: int,
    *,
    effects: Iterable[str],
    attributes: Iterable[str] = (),
    samples: int,
    seed: int,
) -> Images:
    """Trace the `width` x `height` window of `view`'s camera: planar (C, H, W) float32 images.

    Keys are `attributes`, the inputs of `effects`, what these derive from, and for each effect
    `reference_<effect>` and `reference_<effect>_error`. `samples` are per pixel; the same `seed`
    gives the same noise.

    Raises:
        ConfigError: an effect has no reference, or an attribute needs a setting of the view.
        SceneError: the view moves an object that the scene doesn't have.
    """
    references = {effect: reference_of(effect) for effect in effects}
    names = {*attributes, *(name for effect in references for name in EFFECTS[effect].inputs)}
    hits = trace(scene, view.camera, width, height)
    images = make_attributes(scene, view, hits, names, seed=seed)
    for effect, reference in references.items():
        value, error = reference(scene, view, hits, images, samples=samples, seed=seed)
        images[f"reference_{effect}"] = value
        images[f"reference_{effect}_error"] = error
    return images
