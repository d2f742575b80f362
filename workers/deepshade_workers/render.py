"""Renders one view to an EXR with every canonical attribute and the references asked for."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.effects import EFFECTS
from deepshade_workers.sample import render_sample
from deepshade_workers.sampling import rays_used
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.view import Images, View


def render(
    scene: Scene,
    view: View,
    target: Path,
    *,
    effects: Sequence[str],
    samples: int,
    seed: int,
    attributes: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Figures for a report of `view`, which is rendered and written to `target`.

    `attributes` are those to write, all by default. The same scene, view and seed give the same
    file.

    Raises:
        ConfigError: an effect has no reference, or an attribute needs a setting of the view.
        SceneError: the view moves an object that the scene doesn't have.
    """
    names = tuple(ATTRIBUTES) if attributes is None else tuple(attributes)
    start = time.perf_counter()
    width, height = view.camera.width, view.camera.height
    images = render_sample(
        scene,
        view,
        width,
        height,
        effects=effects,
        attributes={*names, "depth"},
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
    exr.write(
        target, channels_of(images, names, effects), attributes=header, half=half, compression="zip"
    )
    figures: dict[str, Any] = {
        "file": str(target),
        "size": [width, height],
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
        letters = ("V",) if len(outputs) == 1 else outputs
        for layer in (f"reference_{effect}", f"reference_{effect}_error"):
            for letter, plane in zip(letters, images[layer], strict=True):
                found[f"{layer}.{letter}"] = plane
    return found
