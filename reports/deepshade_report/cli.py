"""`deepshade report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/report"),
    data: Annotated[
        Path, typer.Option(help="Held-out views: a folder of 'deepshade datagen'.")
    ] = Path("data/test-real"),
    models: Annotated[
        Path | None,
        typer.Option(help="Folder of bundles, <effect>/<name>/. Default: as 'deepshade serve'."),
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

      deepshade report --paper runs/paper-bundle/ao/paper

      deepshade report --only service --only sizes
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from deepshade.bundles import bundle_root
    from deepshade.effects import EFFECTS
    from deepshade.errors import ConfigError
    from deepshade.machine import cpu_count
    from deepshade_report.context import Context
    from deepshade_report.report import SECTIONS, measure

    for name in only or ():
        if name not in SECTIONS:
            raise ConfigError(
                name, SECTIONS, detail=f"no section is called '{name}': {', '.join(SECTIONS)}"
            )
    if effect not in EFFECTS:
        raise ConfigError(effect, EFFECTS, detail=f"no effect is called '{effect}'")
    threads = threads or cpu_count()
    context = Context(models or bundle_root(), data, out, paper, effect, threads, quick, views)
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description:11}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.fields[doing]}"),
    )
    wanted = [name for name in SECTIONS if not only or name in only]
    total = sum(SECTIONS[name][1] for name in wanted)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, doing="")

        def show(section: str, share: float, doing: str) -> None:
            before = sum(SECTIONS[name][1] for name in wanted[: wanted.index(section)])
            done = before + share * SECTIONS[section][1]
            bar.update(task, completed=done, description=section, doing=doing[:60])

        try:
            found = measure(context, only=only or (), resume=resume, progress=show)
        except KeyboardInterrupt:
            console.print(f"stopped; what is done is in {out}, and --resume goes on")
            raise
    for name, section in found["sections"].items():
        if section["status"] != "done":
            typer.echo(f"skipped {name}: {section['reason']}", err=True)
    typer.echo(f"{out / 'index.html'}")
