"""`deepshade render` and `deepshade datagen`."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

Vector = tuple[float, float, float]


def render(
    scene: Annotated[
        str,
        typer.Argument(help="OBJ, PLY, glTF, GLB, Mitsuba XML, or procedural:<family>:<seed>."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="EXR file to write.")],
    eye: Annotated[Vector, typer.Option(help="The camera's place, scene units.")],
    target: Annotated[Vector, typer.Option(help="What it looks at.")],
    up: Annotated[Vector, typer.Option(help="Upward direction.")] = (0.0, 1.0, 0.0),
    fov: Annotated[float, typer.Option(help="Full horizontal angle, degrees.")] = 50.0,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "768x512",
    effects: Annotated[str, typer.Option(help="References to render, commas between.")] = "ao",
    radius: Annotated[
        float | None, typer.Option(help="Effect radius, scene units.  [default: diagonal / 20]")
    ] = None,
    spp: Annotated[int, typer.Option(help="Reference rays a pixel.", min=2, max=65536)] = 256,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    focus: Annotated[
        float | None, typer.Option(help="Focus distance.  [default: that of the target]")
    ] = None,
    aperture: Annotated[float, typer.Option(help="Lens diameter, scene units.", min=0)] = 0.0,
    attributes: Annotated[
        str, typer.Option(help="Attributes to write, commas between.  [default: all]")
    ] = "",
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Render a view: every canonical attribute, the camera, and the references of EFFECTS.

    Example:

      deepshade render teapot.obj -o out.exr --eye 0 3 6 --target 0 1 0 --radius 0.5
    """
    import math

    from deepshade.camera import Camera
    from deepshade.errors import ConfigError
    from deepshade_workers.references import require
    from deepshade_workers.render import render as render_view
    from deepshade_workers.scenes.loading import open_scene
    from deepshade_workers.view import View

    if radius is not None and not (math.isfinite(radius) and radius > 0):
        raise ConfigError("radius", detail=f"the radius must be above 0, not {radius}")
    names = [name.strip() for name in effects.split(",") if name.strip()]
    require(names)
    chosen = _attributes(attributes)
    width, height = _size(size)
    camera = Camera.look_at(eye, target, up, fov, width, height)
    opened = open_scene(scene)
    view = View(
        camera,
        radius=opened.diagonal / 20 if radius is None else radius,
        focus=math.dist(eye, target) if focus is None else focus,
        aperture=aperture,
    )
    figures = render_view(
        opened, view, output, effects=names, samples=spp, seed=seed, attributes=chosen
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


def _attributes(text: str) -> tuple[str, ...] | None:
    from deepshade.attributes import ATTRIBUTES
    from deepshade.errors import ConfigError

    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        if name not in ATTRIBUTES:
            raise ConfigError(name, ATTRIBUTES, detail=f"no attribute is called {name!r}")
    return names or None


def _size(text: str) -> tuple[int, int]:
    from deepshade.errors import ConfigError

    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()) or not (
        1 <= int(width) <= 16384 and 1 <= int(height) <= 16384
    ):
        raise ConfigError("size", detail=f"--size {text!r} must be like 768x512, up to 16384")
    return int(width), int(height)


def datagen(
    out: Annotated[Path, typer.Option(help="Folder of the data set; an unfinished one goes on.")],
    scenes: Annotated[
        list[str],
        typer.Option(help="Scene file, folder, 'procedural' or 'procedural:<family>'; repeatable."),
    ],
    views: Annotated[int, typer.Option(help="Samples in all.", min=1)] = 256,
    size: Annotated[int, typer.Option(help="Side of a sample, pixels.", min=8, max=4096)] = 256,
    frame: Annotated[
        int | None,
        typer.Option(help="Side of the view that samples are cut from.  [default: size]"),
    ] = None,
    spp: Annotated[int, typer.Option(help="Reference rays a pixel.", min=2)] = 256,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    effects: Annotated[list[str] | None, typer.Option(help="Effects; repeatable.")] = None,
    radius: Annotated[
        float | None, typer.Option(help="Effect radius, scene units.  [default: drawn per view]")
    ] = None,
    min_contrast: Annotated[
        float, typer.Option(help="Least standard deviation of a view's occlusion.")
    ] = 0.06,
    shard_size: Annotated[int, typer.Option(help="Samples in a shard.", min=1)] = 128,
    address: Annotated[
        str | None, typer.Option(help="A running Ray cluster.  [default: one of its own]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON summary.")] = False,
) -> None:
    """Render a data set of random views on Ray.

    Run the same command again to go on after an interruption. Examples:

      deepshade datagen --out data/ao --scenes procedural --views 2048

      ray job submit -- deepshade datagen --out /shared/ao --scenes procedural --views 20000
    """
    from deepshade_workers.datagen import DataSpec, expand_scenes, generate

    spec = DataSpec(
        scenes=expand_scenes(scenes),
        views=views,
        effects=tuple(effects or ["ao"]),
        size=size,
        frame=frame or size,
        spp=spp,
        seed=seed,
        radius=radius,
        min_contrast=min_contrast,
        shard_size=shard_size,
    )
    begun = time.monotonic()
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
    """Samples (done, newly rendered) after all `steps` of (done, in all).

    They show as a bar on a terminal, as a line every 15 s elsewhere.
    """
    from rich import progress
    from rich.console import Console

    console = Console(stderr=True)
    plain = not console.is_terminal
    columns = ("rendering", progress.BarColumn(), progress.MofNCompleteColumn())
    times = ("{task.fields[rate]}", progress.TimeElapsedColumn(), progress.TimeRemainingColumn())
    begun = said = time.monotonic()
    first, done = None, 0
    with progress.Progress(*columns, *times, console=console, disable=plain or hidden) as bar:
        task = bar.add_task("", total=None, rate="")
        for done, total in steps:
            first = done if first is None else first
            now = time.monotonic()
            rate = (done - first) / max(now - begun, 1e-9)
            bar.update(task, completed=done, total=total, rate=f"{rate:.2f}/s")
            if plain and not hidden and now - said > 15:
                said = now
                left = f"{(total - done) / rate / 60:.1f} min left" if rate else ""
                console.print(f"rendering {done}/{total}  {rate:.2f}/s  {left}")
    return done, done - (first or 0)
