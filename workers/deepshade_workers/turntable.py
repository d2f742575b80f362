"""`deepshade turntable`: a camera goes around a scene, and its G-buffers leave as live frames."""

from __future__ import annotations

import math
import struct
import sys
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import numpy as np
import typer
from numpy.typing import NDArray

if TYPE_CHECKING:
    from deepshade_workers.framing import Framing
    from deepshade_workers.scenes.scene import Scene
    from deepshade_workers.view import Light, View

Vector = tuple[float, float, float]

_HALF = ("normal", "diffuse", "specular", "gloss", "view")  # what 16 bits hold
# what follows from the depth and the camera isn't sent
_FROM_DEPTH = ("position", "focal", "view", "view_angle")


def turntable(
    scene: Annotated[
        str, typer.Argument(help="OBJ, PLY, glTF, GLB, Mitsuba XML or procedural:<family>:<seed>.")
    ],
    frames: Annotated[int, typer.Option(min=1, help="Of one turn.")] = 96,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "768x512",
    fov: Annotated[float, typer.Option(help="Full horizontal angle, degrees.")] = 50.0,
    degrees: Annotated[float, typer.Option(help="How far it goes around.")] = 360.0,
    focus: Annotated[
        float | None, typer.Option(help="Focus distance at first. Default: the target's.")
    ] = None,
    focus_to: Annotated[
        float | None, typer.Option(help="Focus distance in the middle of the turn; then back.")
    ] = None,
    aperture: Annotated[float, typer.Option(min=0, help="Lens diameter, scene units.")] = 0.0,
    attributes: Annotated[
        str, typer.Option(help="What is needed, commas between.")
    ] = "normal,position",
    spp: Annotated[int, typer.Option(min=1, help="Rays a pixel for light.")] = 16,
    loop: Annotated[bool, typer.Option("--loop", help="Turn for ever.")] = False,
) -> None:
    """Write G-buffers of a camera that goes around a scene to stdout, as docs/streaming.md says.

    Where the scene is a room, the camera turns in its place. Example:

      deepshade turntable teapot.glb | deepshade-client stream ao - -o ao/
    """
    from deepshade.attributes import ATTRIBUTES
    from deepshade.errors import ConfigError
    from deepshade_workers.cli import _size
    from deepshade_workers.scenes.loading import open_scene
    from deepshade_workers.scenes.summary import warn

    needed = [name.strip() for name in attributes.split(",") if name.strip()]
    for name in needed:
        if name not in ATTRIBUTES:
            raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called {name!r}")
    if sys.stdout.isatty():
        raise ConfigError("stdout", detail="frames are no text; pipe them to deepshade-client")
    sent = list(dict.fromkeys("depth" if name in _FROM_DEPTH else name for name in needed))
    opened = open_scene(scene)
    warn(opened.notes)
    width, height = _size(size)
    views = list(path(opened, frames, (width, height), fov, degrees, (focus, focus_to), aperture))
    while True:
        for id_, view in enumerate(views, 1):
            write(sys.stdout.buffer, planes(opened, view, (width, height), sent, spp), view, id_)
        if not loop:
            return


def path(
    scene: Scene,
    frames: int,
    size: tuple[int, int],
    fov: float,
    degrees: float,
    focus: tuple[float | None, float | None],
    aperture: float,
) -> Iterator[View]:
    """The views of a turn: around what is seen from outside, or in place within a room."""
    from deepshade.camera import Camera
    from deepshade_workers.framing import frame
    from deepshade_workers.view import View

    found = frame(scene, fov, *size)
    usual = math.dist(found.eye, found.target)
    first = focus[0] or usual
    for index in range(frames):
        eye, target = turned(found, math.radians(degrees) * index / frames)
        way = 0.5 - 0.5 * math.cos(2 * math.pi * index / frames)
        yield View(
            Camera.look_at(eye, target, (0, 1, 0), fov, *size),
            radius=scene.diagonal / 20,
            focus=first + way * ((focus[1] or first) - first),
            aperture=aperture,
            light=_lamp(scene, found),
        )


def turned(found: Framing, angle: float) -> tuple[Vector, Vector]:
    """(eye, target) after so many radians about the vertical: of the eye, or in a room the target.

    Counter-clockwise, seen from above.
    """
    centre, moved = np.array(found.target), np.array(found.eye)
    if found.place == "inside":
        centre, moved = moved, centre
    x, y, z = moved - centre
    cosine, sine = math.cos(angle), math.sin(angle)
    place = centre + np.array([cosine * x + sine * z, y, cosine * z - sine * x])
    ends = (tuple(float(v) for v in end) for end in (place, centre))
    eye, target = ends
    return (target, eye) if found.place == "inside" else (eye, target)  # type: ignore[return-value]


def _lamp(scene: Scene, found: Framing) -> Light:
    """One that stays: above, to the side of where the camera began."""
    from deepshade_workers.view import Light

    eye, target = np.array(found.eye), np.array(found.target)
    distance = float(np.linalg.norm(eye - target))
    aside = np.cross(eye - target, (0, 1, 0))
    place = target + 0.5 * (eye - target) + 0.4 * aside + np.array([0, 0.8 * distance, 0])
    if found.place == "inside":
        place = eye + np.array([0, 0.1 * distance, 0])
    power = 2.5 * float(np.linalg.norm(place - target)) ** 2
    where = tuple(float(v) for v in place)
    return Light(where, 0.02 * distance, (power,) * 3, *[(0.4,) * 3] * 3)  # type: ignore[arg-type]


def planes(
    scene: Scene, view: View, size: tuple[int, int], attributes: list[str], spp: int
) -> dict[str, NDArray[Any]]:
    """The planes of a view by their canonical names, each in the bits that it needs."""
    from deepshade.floats import to_half
    from deepshade_workers.render import channels_of, render_sample

    images = render_sample(
        scene, view, *size, effects=(), attributes=attributes, samples=spp, seed=0
    )
    found: dict[str, NDArray[Any]] = {}
    for name in attributes:
        for channel, plane in channels_of(images, [name], ()).items():
            narrow = name in _HALF or name.startswith("light")
            found[channel] = to_half(plane) if narrow else np.ascontiguousarray(plane, np.float32)
    return found


def write(stream: BinaryIO, found: Mapping[str, NDArray[Any]], view: View, id_: int) -> None:
    """One frame behind its length."""
    from deepshade import live

    header = {
        key: np.asarray(value).ravel().tolist() if isinstance(value, np.ndarray | tuple) else value
        for key, value in view.header().items()
        if key != "deepshade:radius"
    }
    now = time.time()
    about = {"header": header}
    message = live.pack(live.GBUFFER, id_, found, about, codec="raw", time=now, sent=now)
    stream.write(struct.pack("<I", len(message)) + message)
    stream.flush()


def main() -> int:
    """`python -m deepshade_workers.turntable`: how the client starts it."""
    from deepshade.cli import run

    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(turntable)
    return run(typer.main.get_command(app), name="deepshade turntable")


if __name__ == "__main__":
    sys.exit(main())
