"""`deepshade-client`: shade pictures through a running service, and see what it offers."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from deepshade import tracing
from deepshade.cli import CONTEXT, Version, run
from deepshade_client import training
from deepshade_client.exceptions import NotReady, TransportError
from deepshade_client.settings import DEFAULT_SERVER

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)

Server = Annotated[
    str, typer.Option("--server", envvar="DEEPSHADE_SERVER", help="Address of the service.")
]
EXIT_CODES = (
    "Exit codes: 0 all is saved or was there, 1 some pictures failed, 2 wrong usage or input, "
    "3 the service can't be reached or isn't ready, 130 interrupted (Ctrl-C)."
)
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output on stdout.")]


@app.callback()
def root(show_version: Version = False) -> None:
    """Shade G-buffers through a running deepshade service.

    Example: deepshade-client shade ao renders/*.exr -o shaded/ --radius 0.5
    """
    tracing.begin("deepshade-client")


@app.command(epilog=EXIT_CODES)
def shade(
    effect: Annotated[
        str, typer.Argument(help="Which effect, as ao; or several, as ao,gi: a layer each.")
    ],
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="IN...", help="EXR files, folders, patterns: 'a/*.exr', room.####.exr."
        ),
    ],
    out: Annotated[
        str | None,
        typer.Option(
            "--out",
            "-o",
            help="A file (.exr or .png), a folder, or a pattern with {name}, {effect}, or #### or "
            "%04d for the frame.",
        ),
    ] = None,
    radius: Annotated[
        str | None, typer.Option(help="Effect radius: scene units, or a share of the depth as 15%.")
    ] = None,
    focus: Annotated[float | None, typer.Option(help="Distance in focus, scene units.")] = None,
    aperture: Annotated[float | None, typer.Option(help="Lens diameter, scene units.")] = None,
    shutter: Annotated[float | None, typer.Option(help="Open for so many frames.")] = None,
    environment: Annotated[
        str | None, typer.Option(help="The map that lights the scene: see `environments`.")
    ] = None,
    rotate: Annotated[
        float | None, typer.Option(help="Degrees to turn it by, counter-clockwise from above.")
    ] = None,
    up: Annotated[Literal["y", "z"] | None, typer.Option(help="The world's up axis.")] = None,
    fov: Annotated[float | None, typer.Option(help="Full horizontal angle, degrees.")] = None,
    projection: Annotated[
        Literal["perspective", "orthographic", "latlong"] | None,
        typer.Option(help="The camera's, where the header doesn't say."),
    ] = None,
    ortho_width: Annotated[
        float | None, typer.Option(help="Width of an orthographic frame, scene units.")
    ] = None,
    view: Annotated[
        str | None, typer.Option(help="Which view of a stereo file, or part of a file.")
    ] = None,
    world_to_camera: Annotated[
        str | None,
        typer.Option(help="The camera's matrix: 16 numbers, row by row, for column vectors."),
    ] = None,
    map_: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="ATTR=CHANNEL", help="Where an attribute is; repeatable."),
    ] = None,
    profile: Annotated[str | None, typer.Option(help="Renderer whose names to expect.")] = None,
    axes: Annotated[
        list[str] | None,
        typer.Option(help="Stored axes, as position:x,-y,-z or opencv; repeatable."),
    ] = None,
    normals: Annotated[
        Literal["signed", "encoded", "scaled"] | None, typer.Option(help="How normals are stored.")
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="What is stored as depth: planar, distance, inverse, …")
    ] = None,
    near: Annotated[float | None, typer.Option(help="Depth of the near plane.")] = None,
    far: Annotated[float | None, typer.Option(help="Depth of the far plane.")] = None,
    derive: Annotated[
        list[str] | None, typer.Option(help="An attribute to derive, though it is there.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Warnings are errors.")] = False,
    trust: Annotated[bool, typer.Option("--trust", help="Skip checks of the input.")] = False,
    bundle: Annotated[str | None, typer.Option(help="Which of the effect's bundles.")] = None,
    quality: Annotated[
        Literal["fast", "balanced", "best"] | None,
        typer.Option(help="The bundle of that name.", case_sensitive=False),
    ] = None,
    max_error: Annotated[
        float | None, typer.Option(help="The fastest bundle with at most this error (DSSIM).")
    ] = None,
    budget_ms: Annotated[
        float | None,
        typer.Option(help="The most accurate bundle whose network takes at most so long."),
    ] = None,
    engine: Annotated[str | None, typer.Option(help="What it must run on, as openvino.")] = None,
    precision: Annotated[
        Literal["fp32", "bf16", "fp16", "int8"] | None,
        typer.Option(help="How exactly it must calculate."),
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the plan as JSON; shade and save nothing.")
    ] = False,
    png: Annotated[
        bool, typer.Option("--png", help="8-bit PNG instead of EXR, in a folder.")
    ] = False,
    compression: Annotated[
        str | None, typer.Option(help="Of the EXR, as zip, piz or htj2k256.")
    ] = None,
    full: Annotated[bool, typer.Option("--float", help="32-bit pixels instead of 16.")] = False,
    append: Annotated[
        bool, typer.Option("--append", help="The input's own channels too, in the same EXR.")
    ] = False,
    layer: Annotated[str | None, typer.Option(help="Name of the answer's layer, as AO.")] = None,
    multiply: Annotated[
        bool, typer.Option("--multiply", help="The input's beauty times the answer.")
    ] = False,
    together: Annotated[
        bool | None,
        typer.Option(
            "--together/--apart",
            help="All inputs are one view, or each is its own; else by their names: "
            "shot_normal.0001.exr and shot_depth.0001.exr are one frame.",
            show_default=False,
        ),
    ] = None,
    skip_existing: Annotated[
        bool,
        typer.Option("--skip-existing", help="Leave answers that are whole and newer than inputs."),
    ] = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Requests in flight.")] = 3,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for an answer.")] = 600.0,
    retries: Annotated[int, typer.Option(min=0, help="Further attempts when it's busy.")] = 5,
    server: Server = DEFAULT_SERVER,
    as_json: AsJson = False,
) -> None:
    """Shade pictures and save the answers; or, with --explain, say how that would be done.

    Examples:

      deepshade-client shade ao renders/*.exr -o shaded/ --radius 0.5

      deepshade-client shade ao,gi,dof room.exr -o room-shaded.exr --focus 3 --aperture 0.1

      deepshade-client shade ao shot.exr --explain
    """
    from deepshade.gbuffer.channels import parse_mapping
    from deepshade_client import batch, report
    from deepshade_client.client import AsyncClient, Client
    from deepshade_client.request import Options
    from deepshade_client.settings import Retry, Timeout

    suffix = batch.suffix_of(out, png=png)
    options = Options(
        radius=radius,
        focus=focus,
        aperture=aperture,
        shutter=shutter,
        environment=environment,
        rotate=rotate,
        up=up,
        fov=fov,
        projection=projection,
        ortho_width=ortho_width,
        view=view,
        world_to_camera=world_to_camera,
        profile=profile,
        mapping=parse_mapping(map_ or []),
        axes=axes,
        normals=normals,
        depth=depth,
        near=near,
        far=far,
        derive=derive,
        strict=strict or None,
        trust=trust or None,
        bundle=bundle,
        quality=quality,
        max_error=max_error,
        budget_ms=budget_ms,
        engine=engine,
        precision=precision,
        format="png" if suffix == ".png" else "exr",
        compression=compression,
        half=False if full else None,
        append=append or None,
        layer=layer,
        multiply=multiply or None,
    )
    retry, wait = Retry(attempts=retries + 1), Timeout(answer=timeout)
    if explain:
        with Client(server, retry=retry, timeout=wait) as client:
            plans = [
                {
                    "input": [str(path) for path in view.files],
                    "plan": client.explain(effect, batch.picture_of(view.files), options),
                }
                for view in batch.views(inputs, together=together)
            ]
        _print_json({"pictures": plans})
        return
    if out is None:
        raise batch.UsageError("where shall the answers go?", fix="name a file or folder: --out")
    tasks = batch.plan(inputs, out, effect=effect, suffix=suffix, together=together)
    with report.progress(len(tasks), quiet=as_json) as bar:
        found = report.Batch(tasks, bar, quiet=as_json)
        found.open()

        async def shade_all() -> None:
            async with AsyncClient(
                server, retry=retry, timeout=wait, waiting=found.waiting
            ) as client:
                await batch.run(
                    client, effect, tasks, options, jobs=jobs, done=found.done, skip=skip_existing
                )

        try:
            asyncio.run(shade_all())
            interrupted = False
        except KeyboardInterrupt:
            interrupted = True
        found.close(interrupted=interrupted)
    if as_json:
        _print_json(found.as_json())
    if interrupted:
        raise typer.Exit(130)
    failed = [result.error for result in found.results if result.error]
    if failed:
        unreached = all(isinstance(error, TransportError | NotReady) for error in failed)
        raise typer.Exit(3 if unreached else 1)


@app.command(epilog=EXIT_CODES)
def stream(
    effect: Annotated[str, typer.Argument(help="Which effect, as ao; or several, as ao,gi,dof.")],
    source: Annotated[
        str,
        typer.Argument(
            help="Frames as 'room.####.exr', a folder or a file; - for frames that a renderer "
            "writes to stdin; or with --turntable a scene."
        ),
    ],
    out: Annotated[
        str | None,
        typer.Option("--out", "-o", help="A folder, or a pattern with #### for the frame."),
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(
            "--live",
            help="The session's name, for those who watch at /live/<name>.",
            metavar="NAME",
        ),
    ] = None,
    tev: Annotated[
        str | None,
        typer.Option(help="Show it in tev or HDRView, as 127.0.0.1:14158.", metavar="HOST:PORT"),
    ] = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="SOURCE is a folder: shade what appears in it.")
    ] = False,
    turntable: Annotated[
        bool,
        typer.Option("--turntable", help="SOURCE is a scene: go around it (needs the workers)."),
    ] = False,
    frames: Annotated[int, typer.Option(min=1, help="Of a turn.")] = 96,
    size: Annotated[str, typer.Option(help="Of a turntable's pictures.")] = "768x512",
    focus_to: Annotated[
        float | None, typer.Option(help="Focus in the middle of a turn; at first it is --focus.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000, help="Play a sequence at so many frames a second."),
    ] = None,
    loop: Annotated[bool, typer.Option("--loop", help="Begin anew at the end.")] = False,
    fps: Annotated[
        float | None,
        typer.Option(
            min=1, max=240, help="Hold this rate by smaller pictures; whole ones when it rests."
        ),
    ] = None,
    history: Annotated[
        bool, typer.Option("--history", help="Take over from the answer before: less flicker.")
    ] = False,
    codec: Annotated[
        Literal["raw", "lz4", "zstd", "deflate", "htj2k"] | None,
        typer.Option(help="Of frames on the way. Default: by how fast the link is."),
    ] = None,
    radius: Annotated[
        str | None, typer.Option(help="Effect radius: scene units, or a share of the depth as 15%.")
    ] = None,
    focus: Annotated[float | None, typer.Option(help="Distance in focus, scene units.")] = None,
    aperture: Annotated[float | None, typer.Option(help="Lens diameter, scene units.")] = None,
    shutter: Annotated[float | None, typer.Option(help="Open for so many frames.")] = None,
    environment: Annotated[str | None, typer.Option(help="The map that lights the scene.")] = None,
    rotate: Annotated[float | None, typer.Option(help="Degrees to turn it by.")] = None,
    up: Annotated[Literal["y", "z"] | None, typer.Option(help="The world's up axis.")] = None,
    fov: Annotated[float | None, typer.Option(help="Full horizontal angle, degrees.")] = None,
    map_: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="ATTR=CHANNEL", help="Where an attribute is; repeatable."),
    ] = None,
    profile: Annotated[str | None, typer.Option(help="Renderer whose names to expect.")] = None,
    bundle: Annotated[str | None, typer.Option(help="Which of the effect's bundles.")] = None,
    quality: Annotated[
        Literal["fast", "balanced", "best"] | None, typer.Option(help="The bundle of that name.")
    ] = None,
    trust: Annotated[bool, typer.Option("--trust", help="Skip checks of the input.")] = False,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="DEEPSHADE_TOKEN", help="The service's, where it has one.", show_default=False
        ),
    ] = None,
    patience: Annotated[
        float, typer.Option(min=0, help="Seconds to try again when the service is gone.")
    ] = 60.0,
    server: Server = DEFAULT_SERVER,
    as_json: AsJson = False,
) -> None:
    """Send frames as they come, and show or save the shaded ones at once.

    With --out every frame is shaded; else the newest wins, and no lag builds up. Examples:

      deepshade-client stream ao 'room.####.exr' -o ao/

      deepshade-client stream ao,gi renders/ --watch --live shot

      deepshade-client stream ao,gi,dof teapot.glb --turntable --aperture 0.1 --live pot

      my-renderer | deepshade-client stream ao - --tev 127.0.0.1:14158
    """
    from secrets import token_hex

    from deepshade.gbuffer.channels import parse_mapping
    from deepshade_client.live import command
    from deepshade_client.request import Options

    turn: tuple[str, ...] | None = None
    if turntable:
        given = {"--focus": focus, "--focus-to": focus_to, "--aperture": aperture, "--fov": fov}
        turn = (source, "--frames", str(frames), "--size", size, *(["--loop"] if loop else []))
        turn += tuple(text for name, v in given.items() if v is not None for text in (name, str(v)))
        focus = aperture = fov = None  # each of its frames says its own
    plan = command.Plan(source, out, tev, watch, rate, loop and turn is None, turn)
    plan.check(fps)
    options = Options(
        radius=radius,
        focus=focus,
        aperture=aperture,
        shutter=shutter,
        environment=environment,
        rotate=rotate,
        up=up,
        fov=fov,
        mapping=parse_mapping(map_ or []),
        profile=profile,
        bundle=bundle,
        quality=quality,
        trust=trust or None,
    )
    tally = command.Tally()
    work = command.run(
        plan,
        server,
        live or f"stream-{token_hex(4)}",
        effect,
        options,
        quiet=as_json,
        tally=tally,
        fps=fps,
        history=history,
        codec=codec,
        token=token,
        patience=patience,
    )
    interrupted = False
    try:
        asyncio.run(work)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        if as_json:
            _print_json(tally.as_json())
    if not as_json:
        found = tally.as_json()
        ages = found["age_ms"]
        age = f", {ages['median']:.0f} ms old in the median, {ages['p95']:.0f} at most of 95 %"
        rates = f", {found['fps']} a second" if found["fps"] else ""
        typer.echo(
            f"{found['answered']} answered{rates}, {found['dropped']} dropped{age if ages else ''}",
            err=True,
        )
    if interrupted:
        raise typer.Exit(130)
    if tally.failed:
        raise typer.Exit(1)


@app.command()
def effects(server: Server = DEFAULT_SERVER, as_json: AsJson = False) -> None:
    """List the effects: their inputs, their settings with ranges, and the service's bundles.

    Example: deepshade-client effects --server http://farm:8000
    """
    from deepshade_client.report import print_effects

    found = _effects(server)
    (_print_json if as_json else print_effects)(found)


@app.command()
def environments(
    add: Annotated[
        list[Path] | None,
        typer.Option(help="Send this map first, named as its file; repeatable.", exists=True),
    ] = None,
    server: Server = DEFAULT_SERVER,
    as_json: AsJson = False,
) -> None:
    """List the environment maps of the service, and add some where it allows that.

    Example: deepshade-client environments --add studio.hdr
    """
    from deepshade_client.client import Client
    from deepshade_client.report import print_environments
    from deepshade_client.settings import Retry

    with Client(server, retry=Retry(attempts=2)) as client:
        for path in add or ():
            client.add_environment(path.stem, path)
        found = client.environments()
    (_print_json if as_json else print_environments)(found)


@app.command()
def models(server: Server = DEFAULT_SERVER, as_json: AsJson = False) -> None:
    """List the model bundles that the service has loaded.

    Example: deepshade-client models --json
    """
    from deepshade_client.report import print_models

    found = [{"effect": e["name"], **bundle} for e in _effects(server) for bundle in e["bundles"]]
    (_print_json if as_json else print_models)(found)


for command in (training.train, training.jobs, training.bundles, training.pin, training.rollback):
    app.command()(command)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit code, and says on stderr what went wrong."""
    try:
        return run(typer.main.get_command(app), arguments, name="deepshade-client")
    finally:
        tracing.end()


def _effects(server: str) -> list[dict[str, Any]]:
    from deepshade_client.client import Client
    from deepshade_client.settings import Retry

    with Client(server, retry=Retry(attempts=2)) as client:
        return client.effects()


def _print_json(document: Any) -> None:
    print(json.dumps(document, indent=2))


if __name__ == "__main__":
    sys.exit(main())
