"""Renders samples/room.exr: a G-buffer with what nine effects need, and their references.

    python scripts/sample.py

About half an hour on two cores. Small enough to ship: what follows from the depth and the camera is
left out; light and references are half floats, of which no more bits are kept than their noise
leaves any meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deepshade import environments, exr
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade_workers.environments import EnvironmentLight
from deepshade_workers.render import channels_of, render_sample
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.view import Light, View

Float = NDArray[np.float32]

SCENE, WIDTH, HEIGHT = "procedural:room:7", 512, 384
EYE, TARGET = (1.4, 1.6, 1.4), (-0.8, 0.6, -0.8)
RAYS = {"ao": 1024, "dof": 256, "mb": 256}  # a pixel, else
SAMPLES = 512
NOISY = {"do", "full", "gi", "ibl"}  # one to four per cent
SHIPPED = (
    *("depth", "normal", "diffuse", "specular", "gloss", "scatter"),
    *("motion", "light", "light_diffuse"),
)


def view() -> View:
    """A lamp of its own, a lens, two chairs that move, and the sky that the service has."""
    return View(
        Camera.look_at(EYE, TARGET, (0, 1, 0), 50, WIDTH, HEIGHT),
        radius=0.4,
        focus=3.2,
        aperture=0.08,
        shutter=1.0,
        displacements={"object 4": (0.16, 0.0, 0.02), "object 9": (-0.05, 0.0, 0.09)},
        light=Light((0.9, 2.6, -0.6), 0.08, (18.0,) * 3, *[(0.3,) * 3] * 3),
        surroundings=EnvironmentLight.of(environments.sky(height=512)),
    )


def main() -> None:
    """Render and write."""
    scene, seen = open_scene(SCENE), view()
    images: dict[str, Float] = {}
    for effect in EFFECTS:
        images |= render_sample(
            *(scene, seen, WIDTH, HEIGHT),
            effects=[effect],
            attributes=SHIPPED,
            samples=RAYS.get(effect, SAMPLES),
            seed=0,
        )
    write(images, seen)


def write(images: Mapping[str, Float], seen: View) -> None:
    """The file, of what was rendered."""
    channels = {
        name: coarse(plane, kept(name))
        for name, plane in channels_of(dict(images), SHIPPED, EFFECTS).items()
        if "_error" not in name
    }
    channels["Z"] = images["depth"][0]
    exr.write(
        Path("samples/room.exr"),
        channels,
        half=[name for name in channels if name != "Z"],
        attributes={**seen.header(), "deepshade:scene": SCENE, "deepshade:spp": SAMPLES},
    )


def kept(channel: str) -> int:
    """How many bits behind the point a channel's half floats keep: steps of a noise's size."""
    kind, _, effect = channel.partition(".")[0].partition("_")
    if kind not in ("light", "reference"):
        return 10
    return 5 if effect in NOISY else 6


def coarse(plane: Float, bits_kept: int) -> Float:
    """Half floats rounded to so many bits behind the point; they have 10."""
    unit = 1 << (10 - bits_kept)
    bits = plane.astype(np.float16).view(np.uint16) + np.uint16(unit // 2)
    rounded = bits & np.uint16(0x10000 - unit)
    return rounded.view(np.float16).astype(np.float32)


if __name__ == "__main__":
    main()
