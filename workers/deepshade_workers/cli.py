"""`deepshade render` and `deepshade datagen`."""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from deepshade_workers.environments import EnvironmentLight
    from deepshade_workers.scenes.scene import Scene
    from deepshade_workers.view import Light

Vector = tuple[float, float, float]

MAX_SIDE = 16384  # pixels


def render(
    scene: Annotated[
        str,
        typer.Argument(
            help="OBJ, PLY, glTF, GLB, Mitsuba XML, procedural:<family>:<seed>, or "
            "compose:<folders or files, + between>:<seed>."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="EXR file to write.")],
    eye: Annotated[
        Vector | None,
        typer.Option(help="The camera's place, scene units. Default: where most is seen from."),
    ] = None,
    target: Annotated[
        Vector | None, typer.Option(help="What it looks at. Default: the scene's middle.")
    ] = None,
    up: Annotated[Vector, typer.Option(help="Upward direction.")] = (0.0, 1.0, 0.0),
    fov: Annotated[float, typer.Option(help="Full horizontal angle, degrees.")] = 50.0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "768x512",
    effects: Annotated[str, typer.Option(help="References to render, commas between.")] = "ao",
    radius: Annotated[
        float | None, typer.Option(help="Effect radius, scene units. Default: diagonal / 20.")
    ] = None,
    spp: Annotated[int, typer.Option(help="Reference rays a pixel.", min=2, max=65536)] = 256,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    focus: Annotated[
        float | None, typer.Option(help="Focus distance. Default: that of the target.")
    ] = None,
    aperture: Annotated[float, typer.Option(help="Lens diameter, scene units.", min=0)] = 0.0,
    lamp: Annotated[
        Vector | None,
        typer.Option(help="A lamp's place; it and --sky replace the scene's own lights."),
    ] = None,
    lamp_size: Annotated[float, typer.Option(help="Its radius; 0 is a point.", min=0)] = 0.0,
    lamp_power: Annotated[
        float | None,
        typer.Option(help="Its radiant intensity. Default: irradiance 2 on the target.", min=0),
    ] = None,
    sky: Annotated[
        float | None, typer.Option(help="The sky's radiance. Default: 0.3 with a lamp.", min=0)
    ] = None,
    move: Annotated[
        list[str] | None,
        typer.Option(help="NAME=X,Y,Z: how an object moves in the open shutter; repeatable."),
    ] = None,
    environment: Annotated[
        str | None,
        typer.Option(
            help="Environment map (EXR or HDR, latitude-longitude) for do, ibl and full, "
            "or 'sky' for a generated one."
        ),
    ] = None,
    rotate: Annotated[
        float, typer.Option(help="Degrees to turn it by, counter-clockwise from above.")
    ] = 0.0,
    attributes: Annotated[
        str, typer.Option(help="Attributes to write, commas between. Default: all.")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Render a view: every canonical attribute, the camera, and the references of EFFECTS.

    Without --eye the camera is where most of the scene is seen from; it is printed. Examples:

      deepshade render teapot.obj -o out.exr

      deepshade render teapot.obj -o out.exr --eye 0 3 6 --target 0 1 0 --radius 0.5

      deepshade render room.gltf -o out.exr --eye 0 1.5 3 --target 0 1 0 --effects ao,gi \
        --lamp 1 2.2 1 --lamp-size 0.1 --aperture 0.2 --move "chair=0.2,0,0"

      deepshade render room.gltf -o out.exr --eye 0 1.5 3 --target 0 1 0 --effects do,ibl,full \
        --environment studio.hdr --rotate 90 --aperture 0.2
    """
    import math

    from deepshade.attributes import ATTRIBUTES
    from deepshade.camera import Camera
    from deepshade.errors import ConfigError
    from deepshade_workers.references import require
    from deepshade_workers.render import render as render_view
    from deepshade_workers.scenes.loading import open_scene
    from deepshade_workers.scenes.summary import warn
    from deepshade_workers.view import View

    if radius is not None and not (math.isfinite(radius) and radius > 0):
        raise ConfigError("radius", detail=f"the radius must be above 0, not {radius}")
    names = _listed(effects)
    require(names)
    chosen = _listed(attributes)
    for name in chosen:
        if name not in ATTRIBUTES:
            raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called {name!r}")
    width, height = _size(size)
    opened = open_scene(scene)
    warn(opened.notes)
    eye, target = _placed(opened, eye, target, fov, width, height)
    camera = Camera.look_at(eye, target, up, fov, width, height)
    view = View(
        camera,
        radius=opened.diagonal / 20 if radius is None else radius,
        focus=math.dist(eye, target) if focus is None else focus,
        aperture=aperture,
        shutter=1.0,
        displacements=dict(_motion(text) for text in move or []),
        light=_light(lamp, lamp_size, lamp_power, sky, target),
        surroundings=_surroundings(environment, rotate),
    )
    shown = chosen or list(ATTRIBUTES)
    figures = render_view(
        opened, view, output, effects=names, attributes=shown, samples=spp, seed=seed
    )
    if as_json:
        typer.echo(json.dumps(figures))
        return
    typer.echo(f"{output}: {width}x{height} in {figures['seconds']} s")
    for name in names:
        found = figures[name]
        typer.echo(
            f"  {name}: mean {found['mean']}, contrast {found['contrast']}, "
            f"standard error {found['error']}"
        )


def _placed(
    scene: Scene, eye: Vector | None, target: Vector | None, fov: float, width: int, height: int
) -> tuple[Vector, Vector]:
    """Eye and target as given, or of a view that is chosen, and said on standard error."""
    from deepshade.errors import ConfigError
    from deepshade_workers.framing import frame

    if eye is not None:
        if target is None:
            x, y, z = (float(value) for value in scene.bounds.mean(0))
            target = (x, y, z)
        return eye, target
    if target is not None:
        raise ConfigError("eye", detail="--target needs --eye; without both a view is chosen")
    found = frame(scene, fov, width, height)
    places = (" ".join(f"{value:g}" for value in end) for end in (found.eye, found.target))
    typer.echo(
        f"seen from {found.place}: --eye {' --target '.join(places)}  "
        f"(surfaces in {found.seen:.0%} of the scene's cells are in view)",
        err=True,
    )
    return found.eye, found.target


def _motion(text: str) -> tuple[str, Vector]:
    from deepshade.errors import ConfigError

    name, _, values = text.rpartition("=")
    try:
        x, y, z = (float(value) for value in values.split(","))
    except ValueError:
        name = ""
    if not name:
        raise ConfigError("move", detail=f"--move {text!r} must be like 'chair=0.2,0,0'")
    return name, (x, y, z)


def _light(
    lamp: Vector | None, size: float, power: float | None, sky: float | None, target: Vector
) -> Light | None:
    """The view's own light; None where neither lamp nor sky is asked for."""
    import math

    from deepshade_workers.view import Light

    if lamp is None and sky is None:
        return None
    if power is None:
        power = 0.0 if lamp is None else 2 * math.dist(lamp, target) ** 2
    bright = 0.3 if sky is None else sky
    return Light(lamp or target, size, (power,) * 3, *[(bright,) * 3] * 3)


def _surroundings(name: str | None, rotation: float) -> EnvironmentLight | None:
    """The environment in the file `name`; None where none is asked for."""
    import math

    from deepshade import environments
    from deepshade.errors import ConfigError
    from deepshade_workers.environments import EnvironmentLight

    if not math.isfinite(rotation):
        raise ConfigError("rotate", detail=f"--rotate must be finite, not {rotation}")
    if name is None:
        return None
    made = name == "sky" and not Path(name).exists()
    found = environments.sky() if made else environments.read_environment(name)
    return EnvironmentLight.of(found, rotation)


def _listed(text: str) -> list[str]:
    """The names between commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


def _size(text: str) -> tuple[int, int]:
    from deepshade.errors import ConfigError

    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    width, height = map(int, found.groups()) if found else (0, 0)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ConfigError("size", detail=f"--size {text!r} must be like 768x512, up to {MAX_SIDE}")
    return width, height


def datagen(
    out: Annotated[Path, typer.Option(help="Folder of the data set; an unfinished one goes on.")],
    scenes: Annotated[
        list[str],
        typer.Option(
            help="Scene file, folder, 'procedural', 'procedural:<family>' or 'compose:<folders or "
            "files, + between>'; repeatable."
        ),
    ],
    views: Annotated[int, typer.Option(help="Samples in all.", min=1)] = 256,
    size: Annotated[int, typer.Option(help="Side of a sample, pixels.", min=8, max=4096)] = 256,
    frame: Annotated[
        int | None,
        typer.Option(help="Side of the view that samples are cut from. Default: size."),
    ] = None,
    spp: Annotated[int, typer.Option(help="Reference rays a pixel.", min=2)] = 256,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    effects: Annotated[
        list[str] | None, typer.Option(help="Effects, commas between; repeatable.")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Effect radius, scene units. Default: drawn per view.")
    ] = None,
    min_contrast: Annotated[
        float | None,
        typer.Option(
            help="Least standard deviation of a view's occlusion. Default: what counts when "
            "measured, 0.12 with ao, else 0.06."
        ),
    ] = None,
    max_blur: Annotated[float, typer.Option(help="Largest blur circles drawn, pixels.")] = 48.0,
    max_motion: Annotated[float, typer.Option(help="Largest motions drawn, pixels.")] = 64.0,
    max_scatter: Annotated[
        float, typer.Option(help="Largest scattering mean free paths drawn, pixels.")
    ] = 64.0,
    textures: Annotated[
        Path | None, typer.Option(help="Folder of pictures for textures, beside generated ones.")
    ] = None,
    environments: Annotated[
        Path | None,
        typer.Option(
            help="Folder of environment maps for do, ibl and full, beside generated skies."
        ),
    ] = None,
    skies: Annotated[int, typer.Option(help="How many different skies.", min=0)] = 64,
    attributes: Annotated[
        str,
        typer.Option(help="Attributes to store beside the effects' inputs: normal_object, say."),
    ] = "",
    pixels: Annotated[
        int,
        typer.Option(
            help="Samples are so many pixels of views around each scene, for a perceptron.", min=0
        ),
    ] = 0,
    augment: Annotated[
        bool,
        typer.Option(
            "--augment",
            help="Store the eight turns and mirrors of each view, for trainers that turn nothing; "
            "ours needs it not.",
        ),
    ] = False,
    shard_size: Annotated[
        int | None,
        typer.Option(help="Views in a shard. Default: views / 16, 128 at most.", min=1),
    ] = None,
    address: Annotated[
        str | None, typer.Option(help="A running Ray cluster. Default: one of its own.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON summary.")] = False,
) -> None:
    """Render a data set of random views on Ray.

    Run the same command again to go on after an interruption. Where an effect sees light or
    materials, they, the lens and motions are drawn for each view. Examples:

      deepshade datagen --out data/ao --scenes procedural --views 2048

      deepshade datagen --out data/light --scenes procedural --scenes compose:furniture+plants \
        --effects ao,gi --textures pictures --views 2048

      deepshade datagen --out data/env --scenes procedural --effects do,ibl,full \
        --environments maps --views 2048

      deepshade datagen --out data/cat --scenes cat.obj --views 128 --size 512 --pixels 512

      ray job submit -- deepshade datagen --out /shared/ao --scenes procedural --views 20000
    """
    from deepshade_workers.datagen import generate
    from deepshade_workers.dataspec import DataSpec, default_shard_size, expand_scenes
    from deepshade_workers.scenes.loading import notes_of
    from deepshade_workers.scenes.summary import warn

    spec = DataSpec(
        scenes=expand_scenes(scenes),
        views=views,
        effects=tuple(name for text in effects or ["ao"] for name in _listed(text)),
        size=size,
        frame=frame or size,
        spp=spp,
        seed=seed,
        radius=radius,
        min_contrast=min_contrast,
        shard_size=shard_size or default_shard_size(views, out, 8 if augment else 1),
        max_blur=max_blur,
        max_motion=max_motion,
        max_scatter=max_scatter,
        textures=None if textures is None else str(textures),
        environments=None if environments is None else str(environments),
        skies=skies,
        augment=augment,
        attributes=tuple(_listed(attributes)),
        pixels=pixels,
    )
    warn(notes_of(spec.scenes))
    begun = time.monotonic()
    with contextlib.redirect_stdout(sys.stderr):  # where Ray tells of workers that died
        done, fresh = _watched(generate(spec, out, address=address), hidden=as_json)
    seconds = time.monotonic() - begun
    summary = {
        "out": str(out),
        "views": done,
        "rendered": fresh,
        "seconds": round(seconds, 2),
        "views_per_second": round(fresh / max(seconds, 1e-9), 3),
    }
    typer.echo(json.dumps(summary) if as_json else f"{done} views in {out}, {fresh} of them new")


def _watched(steps: Iterator[tuple[int, int]], *, hidden: bool) -> tuple[int, int]:
    """Samples (done, newly rendered) after all `steps` of (done, in all)."""
    from deepshade.console import Watch

    first, done, total = None, 0, 0
    with Watch("rendering", "views", hidden=hidden) as watch:
        try:
            for done, total in steps:
                first = done if first is None else first
                watch.update(done, total)
        except KeyboardInterrupt:
            watch.say(f"stopped at {done} of {total} views; the same command goes on")
            raise
    return done, done - (first or 0)
