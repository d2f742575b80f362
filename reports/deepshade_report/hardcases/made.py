"""Pictures of a few planes, for which the right answer follows by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from deepshade import judging
from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.camera import Camera
from deepshade.effects import Effect
from deepshade_report.hardcases.picture import Float, Picture, white_world

FOV = 50.0
_FIELDS = {"diffuse": 1.0, "specular": 0.0, "gloss": 1.0, "scatter": 0.1, "focal": 0.0}


def flat(
    effect: Effect, height: int, width: int, depth: Float, normal: Float, radius: float
) -> Picture:
    """Surfaces (`depth` (H, W), unit camera-space `normal` (3, H, W)), all lit by 1 everywhere.

    Nothing that the effect does shows: no surface is within the radius of another, light is the
    same all over, all is at rest and reflects no highlights. The truth is the trivial answer.
    """
    camera = Camera(FOV, width, height, np.eye(4))
    there = depth > 0
    position = camera.position_from_depth(np.where(there, depth, 1).astype(np.float32))
    position = np.where(there, position, 0).astype(np.float32)
    away = camera.rays().astype(np.float32)
    known = {
        "position": position,
        "depth": np.where(there, depth, 0)[None].astype(np.float32),
        "normal": normal,
        "normal_world": normal,  # the camera stands as the world does
        "view": -away / np.sqrt((away * away).sum(0)),
        "motion": np.zeros((2, height, width), np.float32),
    }
    planes: dict[str, Float] = {}
    for name in effect.inputs:
        attribute = ATTRIBUTES[name]
        value = 1.0 if attribute.unit is RADIANCE else _FIELDS.get(name, 0.0)
        plane = known.get(name, np.full((len(attribute.channels), height, width), value))
        if not attribute.in_background:
            plane = np.where(there, plane, 0)
        planes[name] = np.ascontiguousarray(plane, np.float32)
    header = {"radius": radius} if "radius" in effect.settings else {}
    surroundings = white_world() if "environment" in effect.settings else None
    picture = Picture(planes, camera, header, {"trust": True}, surroundings, closed=True)
    return replace(picture, truth=doing_nothing(effect, picture), compared=there)


def doing_nothing(effect: Effect, picture: Picture) -> Float:
    """(C', H, W): the trivial answer where nothing shines."""
    images = dict(picture.planes)
    if effect.trivial_layer and effect.trivial_layer not in images:
        images[effect.trivial_layer] = images["diffuse"]  # a white world, no highlights
    blank = np.zeros((len(effect.outputs), *picture.shape), np.float32)
    return judging.trivial(effect, images, blank, picture.surroundings)


def wall(effect: Effect, height: int, width: int, *, radius: float = 0.3) -> Picture:
    """A plane across the view, 2 away."""
    return flat(effect, height, width, np.full((height, width), 2.0), facing(height, width), radius)


def ground(effect: Effect, height: int, width: int) -> Picture:
    """A plane that goes on to the horizon, half a unit below the eye; above it nothing."""
    rays = Camera(FOV, width, height).rays()
    with np.errstate(divide="ignore"):
        depth = np.where(rays[1] < 0, -0.5 / rays[1], 0)
    up = np.zeros((3, height, width), np.float32)
    up[1] = 1
    return flat(effect, height, width, depth, up, 0.3)


def bars(effect: Effect, height: int, width: int) -> Picture:
    """Every 16th column is of something thin, 2 away, before a wall 20 away; the wall counts."""
    depth = np.full((height, width), 20.0)
    depth[:, 8::16] = 2
    picture = flat(effect, height, width, depth, facing(height, width), 0.3)
    return replace(picture, compared=depth > 10)


def coplanar(effect: Effect, height: int, width: int) -> Picture:
    """Two surfaces at one place: each pixel shows one or the other, a few roundings apart."""
    which = np.random.default_rng(0).random((height, width)) < 0.5
    depth = np.where(which, 2.0, 2.0 * (1 + 4 * np.finfo(np.float32).eps))
    return flat(effect, height, width, depth, facing(height, width), 0.3)


def corner(effect: Effect, height: int, width: int, *, radius: float = 0.5) -> Picture:
    """Two endless walls that pass through each other at a right angle, along the picture's middle.

    A point x from the edge is blocked, within R, where a direction's component towards the other
    wall is at least x / R: of the unit disc that cosine weights make of the hemisphere, the segment
    (acos t - t sqrt(1 - t²)) / π with t = x / R. What is seen there shines like all else.
    """
    rays = Camera(FOV, width, height).rays().astype(np.float64)
    depth = 2 / (1 + np.abs(rays[0]))  # |x| = 2 - depth
    side = np.where(rays[0] < 0, 1, -1) / math.sqrt(2)
    normal = np.stack([side, np.zeros_like(side), np.full_like(side, math.sqrt(0.5))])
    picture = flat(effect, height, width, depth, normal.astype(np.float32), radius)
    if "radius" not in effect.settings:
        return picture
    share = np.clip(np.abs(rays[0]) * depth * math.sqrt(2) / radius, 0, 1)
    blocked = (np.arccos(share) - share * np.sqrt(1 - share * share)) / math.pi
    nothing = doing_nothing(effect, picture)
    gathers = effect.trivial == 0.0  # light from what blocks, not past it
    truth = blocked + 0 * nothing if gathers else (1 - blocked) * nothing
    return replace(picture, truth=truth.astype(np.float32))


def facing(height: int, width: int) -> Float:
    """Normals of a plane across the view."""
    normal = np.zeros((3, height, width), np.float32)
    normal[2] = 1
    return normal


Maker = Callable[[Effect, int, int], Picture]
