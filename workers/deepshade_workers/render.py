"""Renders one view: its attributes and the references asked for, as images or an EXR."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade_workers.attributes import make_attributes
from deepshade_workers.references import reference_of
from deepshade_workers.sampling import rays_used
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
    `reference_<name>` and `reference_<name>_error`.
    `samples` are per pixel; the same `seed` gives the same noise.

    Raises:
        ConfigError: an effect has no reference, or an attribute or effect needs a setting of the
            view.
        SceneError: the view moves an object that the scene doesn't have.
    """
    references = {effect: reference_of(effect) for effect in effects}
    names = {*attributes, *(name for effect in references for name in EFFECTS[effect].inputs)}
    hits = trace(scene, view.camera, width, height)
    images = make_attributes(scene, view, hits, names, seed=seed, samples=samples)
    for name, reference in references.items():
        value, error = reference(scene, view, hits, images, samples=samples, seed=seed)
        images[f"reference_{name}"] = value
        images[f"reference_{name}_error"] = error
    return images


def render(
    scene: Scene,
    view: View,
    target: Path,
    *,
    effects: Sequence[str],
    attributes: Sequence[str] = tuple(ATTRIBUTES),
    samples: int,
    seed: int,
) -> dict[str, Any]:
    """Figures for a report of `view`, which is rendered and written to `target`.

    `attributes` are those to write. The same scene, view and seed give the same file.

    Raises:
        ConfigError: an effect has no reference, or an attribute needs a setting of the view.
        SceneError: the view moves an object that the scene doesn't have.
    """
    start = time.perf_counter()
    size = view.camera.width, view.camera.height
    asked = {*attributes, "depth"}
    images = render_sample(
        scene,
        view,
        *size,
        effects=effects,
        attributes=asked,
        samples=samples,
        seed=seed,
    )
    header = {
        **view.header(),
        "deepshade:scene": scene.name,
        "deepshade:seed": str(seed),
        "deepshade:spp": rays_used(samples),
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    # Attributes in 16 bits where their units allow that; references keep 32.
    narrow = [a.channels for a in ATTRIBUTES.values() if a.unit.storage == "float16"]
    half = {channel for channels in narrow for channel in channels}
    exr.write(target, channels_of(images, attributes, effects), attributes=header, half=half)
    figures: dict[str, Any] = {
        "file": str(target),
        "size": list(size),
        "seconds": round(time.perf_counter() - start, 3),
        "background": int((images["depth"] == np.inf).sum()),
    }
    for effect in effects:
        reference = images[f"reference_{effect}"]
        figures[effect] = {
            "mean": round(float(reference.mean()), 4),
            "contrast": round(float(reference.std()), 4),
            "error": round(float(images[f"reference_{effect}_error"].mean()), 5),
        }
    return figures


def channels_of(images: Images, attributes: Iterable[str], effects: Iterable[str]) -> Images:
    """Canonical EXR channels, (H, W), of `attributes` and the references of `effects`."""
    found: Images = {}
    for name in attributes:
        found |= dict(zip(ATTRIBUTES[name].channels, images[name], strict=True))
    for effect in effects:
        outputs = EFFECTS[effect].outputs
        ends = ("V",) if len(outputs) == 1 else outputs
        for layer in (f"reference_{effect}", f"reference_{effect}_error"):
            found |= {f"{layer}.{e}": plane for e, plane in zip(ends, images[layer], strict=True)}
    return found
