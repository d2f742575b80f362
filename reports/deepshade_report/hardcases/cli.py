"""`deepshade hardcases`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def hardcases(
    out: Annotated[Path, typer.Option(help="Folder to write to.")] = Path("out/hardcases"),
    models: Annotated[
        Path | None,
        typer.Option(help="Folder of bundles, <effect>/<name>/. Default: as 'deepshade serve'."),
    ] = None,
    effect: Annotated[list[str] | None, typer.Option(help="Only this effect; repeatable.")] = None,
    bundle: Annotated[
        list[str] | None, typer.Option(help="Only bundles of this name; repeatable.")
    ] = None,
    case: Annotated[
        list[str] | None,
        typer.Option(help="Only cases whose name holds this text; repeatable."),
    ] = None,
    large: Annotated[bool, typer.Option("--large", help="8K too: slow, and 8 GiB.")] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small pictures, one bundle an effect, in fp32.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Keep rows that are measured.")] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Of a network run. Default: the CPUs we may use.")
    ] = None,
    document: Annotated[
        Path | None, typer.Option(help="Renew the table between this Markdown file's marks.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print rows as JSON lines.")] = False,
) -> None:
    """Shade hard G-buffers on every engine and precision; say what is off, the worst first.

    Each is held against path tracing, a closed form, or the network in float64, and its line is
    a tenth over the easy picture's error. Exits with 1 where a row is over. Ctrl-C keeps what is
    done: --resume goes on.

      deepshade hardcases --quick

      deepshade hardcases --effect ao --case 65504 --json

      deepshade hardcases --resume --document docs/numerics.md
    """
    import json as json_module

    from deepshade.bundles import bundle_root
    from deepshade.console import Watch
    from deepshade.effects import EFFECTS
    from deepshade.errors import ConfigError
    from deepshade.machine import cpu_count, describe
    from deepshade_report.hardcases import table
    from deepshade_report.hardcases.session import Session, chosen_cases

    for name in effect or ():
        if name not in EFFECTS:
            raise ConfigError(name, EFFECTS, detail=f"no effect is called '{name}'")
    cases = chosen_cases(case or (), large=large)
    session = Session(
        models or bundle_root(), out, cases, quick=quick, threads=threads or cpu_count()
    )
    rows = []
    with Watch("hard cases", "cases", hidden=json) as watch:
        try:
            for done, total, own in session.measure(effect or (), bundle or (), resume=resume):
                watch.update(done, total, f"{own[0].effect}/{own[0].bundle}" if own else "")
                rows += own
                for row in own if json else ():
                    typer.echo(json_module.dumps(row.as_json()))
        except KeyboardInterrupt:
            watch.say(f"stopped; what is done is in {session.file}, and --resume goes on")
            raise
    if document is not None:
        table.renew(document, rows, describe())
    if not json:
        typer.echo(table.markdown(rows, describe()))
    failed = sum(not row.passed for row in rows)
    typer.echo(f"{failed} of {len(rows)} rows are over their line: {session.file}", err=True)
    if failed:
        raise typer.Exit(1)
