"""`deepshade study`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def study(
    name: Annotated[
        str,
        typer.Argument(
            help="radius, fov, time, artefacts (of the bundles that ship); structure, loss, "
            "diversity, effects, regressors (which train)."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/studies"),
    data: Annotated[
        Path, typer.Option(help="Folder of the rendered data sets, which all studies share.")
    ] = Path("data/study"),
    views: Annotated[
        Path | None,
        typer.Option(
            help="Held-out views of 'deepshade datagen' for radius, fov, time and artefacts. "
            "Default: procedural ones, rendered."
        ),
    ] = None,
    models: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of bundles, or 'shipped'; repeatable, the first counts."),
    ] = None,
    large: Annotated[
        bool, typer.Option("--large", help="Many more views and steps: hours, not minutes.")
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="CPU threads. Default: the CPUs we may use.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep points that are measured already.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
) -> None:
    """Repeat an analysis of the papers on our data: NAME.json, its rows, and NAME.png, its plot.

    A few minutes each. Ctrl-C keeps what is done: --resume goes on, within a training too.

      deepshade study fov

      deepshade study structure --large --resume

      deepshade study time --views data/test-real --json
    """
    import json

    from deepshade.bundles import bundle_roots
    from deepshade.console import Watch
    from deepshade.errors import DataError
    from deepshade.machine import cpu_count
    from deepshade_report.studies import study as found_by
    from deepshade_report.studies.common.bench import Bench
    from deepshade_report.studies.common.scale import LARGE, SMALL

    module = found_by(name)
    if views is not None and not views.is_dir():
        raise DataError(f"there is no folder {views}", fix="make it: deepshade datagen --help")
    scale, count = LARGE if large else SMALL, threads or cpu_count()
    with Watch(f"study {name}", "points", hidden=as_json) as watch:
        bench = Bench(
            name,
            out,
            data,
            bundle_roots(models or ()),
            scale,
            count,
            views,
            resume,
            watch.update,
        )
        try:
            rows, picture = bench.run(module)
        except KeyboardInterrupt:
            watch.say(f"stopped; what is done is in {out}, and --resume goes on")
            raise
    typer.echo(json.dumps(rows) if as_json else f"{picture}")
