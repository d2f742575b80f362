"""Attributes of a view: those asked for, and no others."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from deepshade.attributes import ATTRIBUTES
from deepshade.camera import rotation_of
from deepshade.errors import ConfigError
from deepshade.gbuffer import derivation
from deepshade_workers.lighting import direct_light
from deepshade_workers.scenes.scene import MATERIAL_CHANNELS, Scene
from deepshade_workers.trace import Hits, material
from deepshade_workers.view import Image, Images, View

# The fewest rays a pixel that light takes: noise of the input counts as error of the answer.
LIGHT_SAMPLES = 64
# Where an object moves through the plane of the camera, projections end at this share of its depth.
MIN_DEPTH = 1e-3


def make_attributes(
    scene: Scene,
    view: View,
    hits: Hits,
    names: Iterable[str],
    *,
    seed: int,
    samples: int = LIGHT_SAMPLES,
) -> Images:
    """Planar (C, H, W) float32 images of the attributes `names`, and of those they derive from.

    Background pixels hold 0, but infinite depth, and what attributes say of the background (the
    sky's light, the blur at infinity, the direction to the camera). `samples` (at least
    64 are taken) and `seed` are those of the light.

    Raises:
        ConfigError: an attribute needs a setting that the view lacks.
        SceneError: the view moves an object that the scene doesn't have.
    """
    camera, header = view.camera, view.header()
    met = derivation.requirements(camera, camera.matrix, header)
    made = {*_TRACED, *_LIGHT}
    wanted = set(names)
    steps: list[derivation.Derivation] = []
    for name in sorted(wanted):
        found = derivation.plan(name, {*made, *(step.target for step in steps)}, met)
        if found is None:
            lacking = derivation.requirement_text(derivation.unmet(name, made, met))
            raise ConfigError(name, detail=f"the attribute {name!r} needs {lacking}")
        steps += found
    wanted |= {need for step in steps for need in step.needs}
    images = {name: make(scene, view, hits) for name, make in _TRACED.items() if name in wanted}
    if not wanted.isdisjoint(_LIGHT):
        count = max(samples, LIGHT_SAMPLES)
        light = direct_light(scene, view, hits, samples=count, seed=seed)
        images |= {name: image for name, image in zip(_LIGHT, light, strict=True) if name in wanted}
    images = {name: np.ascontiguousarray(image, np.float32) for name, image in images.items()}
    source = derivation.Source(images, _valid(hits), camera, camera.matrix, header)
    for step in steps:
        value = step.function(source)
        if not ATTRIBUTES[step.target].in_background:
            value = np.where(source.valid, value, 0)
        images[step.target] = np.ascontiguousarray(value, np.float32)
    return images


def _valid(hits: Hits) -> np.ndarray:
    return np.asarray(hits.valid.numpy().reshape(hits.height, hits.width))


def _depth(scene: Scene, view: View, hits: Hits) -> Image:
    return np.where(_valid(hits), hits.planar(hits.depth), np.inf)


def _position(scene: Scene, view: View, hits: Hits) -> Image:
    depth = np.where(_valid(hits), hits.planar(hits.depth), 0)
    return np.asarray(view.camera.rays(hits.width, hits.height) * depth)


def _normal(scene: Scene, view: View, hits: Hits) -> Image:
    normal = rotation_of(view.camera.matrix) @ hits.ns.numpy().astype(np.float64)
    return np.where(_valid(hits), normal.reshape(3, hits.height, hits.width), 0)


def _normal_object(scene: Scene, view: View, hits: Hits) -> Image:
    """In the space that each object was modelled in; a Mitsuba XML scene's is the world's.

    A normal goes to the world by the inverse transpose of an object's matrix M, and so back by
    M's transpose.
    """
    normal = hits.ns.numpy().astype(np.float64)
    if any(item.frame for item in scene.objects):
        number = material(scene, view, hits.surface, hits.valid, "object", 1).numpy()
        frames = {item.frame for item in scene.objects} - {()}
        for frame in frames:
            chosen = np.isin(number, [k for k, o in enumerate(scene.objects) if o.frame == frame])
            turned = np.reshape(frame, (3, 3)).T @ normal[:, chosen]
            length = np.linalg.norm(turned, axis=0)
            normal[:, chosen] = turned / np.maximum(length, 1e-30)
    return np.where(_valid(hits), normal.reshape(3, hits.height, hits.width), 0)


def _material(scene: Scene, view: View, hits: Hits, *, name: str) -> Image:
    start, stop = MATERIAL_CHANNELS[name]
    return np.where(
        _valid(hits),
        hits.planar(material(scene, view, hits.surface, hits.valid, name, stop - start)),
        0,
    )


def _motion(scene: Scene, view: View, hits: Hits) -> Image:
    """(2, H, W) pixels from where a surface is when the shutter opens to where when it closes."""
    motion = np.zeros((2, hits.height, hits.width))
    if not view.displacements:
        return motion.astype(np.float32)
    camera, valid = view.camera, _valid(hits)
    number = material(scene, view, hits.surface, hits.valid, "object", 1).numpy().astype(np.int64)
    world = scene.displacements(view.displacements)[number].T  # (3, N)
    half = (rotation_of(camera.matrix) @ world).reshape(3, hits.height, hits.width) / 2
    middle = _position(scene, view, hits).astype(np.float64)
    for sign in (1, -1):
        x, y, z = middle + sign * half
        depth = np.maximum(-z, np.where(valid, -MIN_DEPTH * middle[2], 1))
        motion += sign * np.stack([x, -y * camera.pixel_aspect]) / depth
    return np.where(valid, motion * camera.pixels_per_unit, 0).astype(np.float32)


_TRACED: dict[str, Callable[[Scene, View, Hits], Image]] = {
    "position": _position,
    "normal": _normal,
    "normal_object": _normal_object,
    "depth": _depth,
    "motion": _motion,
    **{name: partial(_material, name=name) for name in MATERIAL_CHANNELS},
}
_LIGHT = ("light", "light_diffuse")
