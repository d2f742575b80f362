"""`deepshade report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/report"),
    data: Annotated[
        Path | None,
        typer.Option(
            help="Held-out views: a folder of 'deepshade datagen', or of EXR files. "
            "Default: the shipped samples."
        ),
    ] = None,
    models: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of bundles, <effect>/<name>/, or 'shipped'; repeatable, the first "
            "counts. Default: as 'deepshade serve'."
        ),
    ] = None,
    paper: Annotated[
        Path | None,
        typer.Option(help="Bundle of the paper's network. Default: <models>/<effect>/paper."),
    ] = None,
    effect: Annotated[str, typer.Option(help="Which effect.")] = "ao",
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of a network run. Default: the CPUs we may use.")
    ] = None,
    views: Annotated[int | None, typer.Option(min=1, help="Held-out views at most.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One or two minutes, rough.")] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="SECTION", help="Measure only this section; repeatable."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep sections that are done already.")
    ] = False,
) -> None:
    """Measure speed against error on this machine; write a page, plots and JSON.

    About eight minutes on two cores. Ctrl-C keeps what is done: --resume goes on.
    The shipped samples are enough for speeds; an error to be quoted needs a data set.

      deepshade report --data data/test

      deepshade report --data data/test-real --paper runs/paper-bundle/ao/paper

      deepshade report --only service --only sizes
    """
    from rich.console import Console
    from rich.progress import Progress, TextColumn

    from deepshade.bundles import bundle_roots
    from deepshade.effects import EFFECTS
    from deepshade.errors import ConfigError, DataError
    from deepshade.files import shipped
    from deepshade.machine import cpu_count
    from deepshade_report.context import Context
    from deepshade_report.report import SECTIONS, measure

    for name in only or ():
        if name not in SECTIONS:
            detail = f"no section is called '{name}': {', '.join(SECTIONS)}"
            raise ConfigError(name, SECTIONS, detail=detail)
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect is called '{effect}'")
    threads = threads or cpu_count()
    roots, data = bundle_roots(models or ()), data or shipped("samples")
    context = Context(roots, data, out, paper, effect, threads, quick, views)
    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), TextColumn("{task.fields[doing]}"))
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=1.0, doing="")

        def show(section: str, share: float, doing: str) -> None:
            bar.update(task, completed=share, description=section, doing=doing[:60])

        try:
            found = measure(context, only=only or (), resume=resume, progress=show)
        except KeyboardInterrupt:
            console.print(f"stopped; what is done is in {out}, and --resume goes on")
            raise
    skipped = [
        f"{name}: {section['reason']}"
        for name, section in found["sections"].items()
        if section["status"] != "done"
    ]
    if len(skipped) == len(found["sections"]):
        raise DataError(f"nothing could be measured: {'; '.join(skipped)}")
    for line in skipped:
        typer.echo(f"skipped {line}", err=True)
    typer.echo(f"{out / 'index.html'}")
