"""Synthetic views of light: what the rivals of effects that carry it are tested on."""

from __future__ import annotations

import numpy as np

from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade_report.view import Float, View


def plates(effect: str, background: np.ndarray | None = None, **planes: np.ndarray) -> View:
    """A view of given attributes: (H, W) or (C, H, W), and light grey or coloured."""
    light = planes["light"]
    planes["light"] = light if light.ndim == 3 else np.broadcast_to(light, (3, *light.shape))
    made: dict[str, Float] = {
        name: np.array(plane, np.float32).reshape(-1, *light.shape[-2:])
        for name, plane in planes.items()
    }
    height, width = light.shape[-2:]
    empty = np.zeros((height, width), bool) if background is None else background
    camera = Camera(50.0, width, height)
    return View("plates", EFFECTS[effect], made, empty, made["light"], 1.0, camera)


def noise(height: int = 32, width: int = 48, channels: int = 3, seed: int = 0) -> Float:
    """(C, H, W) random light, linear, of several decades."""
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(0, 2, (channels, height, width))).astype(np.float32)
