"""Renders one view to an EXR with every canonical attribute and the references asked for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.attributes import ATTRIBUTES
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.gbuffer import derivation
from deepshade_workers.lighting import direct_light
from deepshade_workers.references.ao import rays_used
from deepshade_workers.sample import Images, render_sample
from deepshade_workers.scenes.scene import Scene

LIGHT_SAMPLES = 64
# Bounded values lose nothing to speak of in 16 bits; lengths and references keep 32.
HALF = ("normal", "normal_world", "view", "view_angle", "diffuse", "specular", "gloss")


def render(
    scene: Scene,
    camera: Camera,
    target: Path,
    *,
    effects: Sequence[str],
    radius: float,
    samples: int,
    seed: int,
    focus: float,
    aperture: float = 0.0,
    attributes: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Render `scene` through `camera` and write `target`; returns figures for a report.

    `attributes` are those to write, all by default.
    `radius`, `focus` (distance) and `aperture` (diameter) are in scene units. The same scene,
    camera and seed give the same file.
    """
    start = time.perf_counter()
    target.parent.mkdir(parents=True, exist_ok=True)
    width, height = camera.width, camera.height
    images, hits = render_sample(
        scene,
        camera,
        width,
        height,
        effects=effects,
        radius=radius,
        samples=samples,
        seed=seed,
    )
    light, diffuse = direct_light(scene, hits, samples=LIGHT_SAMPLES, seed=seed)
    images["light"] = light.reshape(3, height, width)
    images["light_diffuse"] = diffuse.reshape(3, height, width)
    images["motion"] = np.zeros((2, height, width), np.float32)  # nothing moves
    header = {
        **camera.to_header(),
        "deepshade:radius": radius,
        "deepshade:focus": focus,
        "deepshade:aperture": aperture,
        "deepshade:scene": scene.name,
        "deepshade:seed": str(seed),
        "deepshade:spp": rays_used(samples),
    }
    derive_rest(images, camera, header)
    exr.write(
        target,
        channels(images, effects, attributes),
        attributes=header,
        half=half_channels(),
        compression="zip",
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


def derive_rest(images: Images, camera: Camera, header: dict[str, Any]) -> None:
    """Add the attributes that follow from those there; background pixels hold 0."""
    valid: NDArray[np.bool_] = np.isfinite(images["depth"][0])
    known = {**images, "depth": np.where(valid, images["depth"], 0).astype(np.float32)}
    source = derivation.Source(known, valid, camera, camera.matrix, header)
    met = derivation.requirements(camera, camera.matrix, header)
    for name in ATTRIBUTES:
        for step in derivation.plan(name, source.arrays, met) or ():
            value = np.where(valid, step.function(source), 0).astype(np.float32)
            source.arrays[step.target] = images[step.target] = value


def channels(
    images: Images, effects: Sequence[str], attributes: Sequence[str] | None = None
) -> dict[str, NDArray[np.float32]]:
    """Canonical EXR channels of `attributes` (all by default) and references in `images`."""
    found: dict[str, NDArray[np.float32]] = {}
    for name in ATTRIBUTES if attributes is None else attributes:
        found |= dict(zip(ATTRIBUTES[name].channels, images[name], strict=True))
    for effect in effects:
        outputs = EFFECTS[effect].outputs
        letters = ("V",) if len(outputs) == 1 else outputs
        for layer in (f"reference_{effect}", f"reference_{effect}_error"):
            for letter, plane in zip(letters, images[layer], strict=True):
                found[f"{layer}.{letter}"] = plane
    return found


def half_channels() -> set[str]:
    """EXR channels stored with 16 bits."""
    return {channel for name in HALF for channel in ATTRIBUTES[name].channels}
