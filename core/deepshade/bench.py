"""`deepshade bench`: milliseconds of every bundle on every engine and precision of this machine."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from deepshade.bundles import Bundle, bundle_folders, bundle_roots
from deepshade.engines import choose, load_engine, usable
from deepshade.environments import black
from deepshade.machine import cpu_count, describe
from deepshade.tensors import channel_slices, up
from deepshade.timing import Pace, alternate

WIDTH, HEIGHT = 768, 512  # the paper's frame
_ROUNDS, _QUICK_ROUNDS = 9, 2


def milliseconds(bundle: Bundle, rounds: int = _ROUNDS) -> dict[str, float]:
    """Median milliseconds of the bare network at 768 x 512, by backend; all take turns.

    All three runs of a network that runs once a colour channel. Input is ready, and noise. Timed as
    reports time: warm, or the last engine's turn would cost the next one 2 ms (4.2 became 6.1).
    """
    multiple = bundle.size_multiple
    gbuffer = noise(bundle, up(HEIGHT, multiple), up(WIDTH, multiple))
    engines = {str(b): load_engine(bundle, b, threads=cpu_count()) for b in usable(bundle)}
    given = (black(bundle.environment),) if bundle.environment else ()
    tasks = {name: partial(engine.predict, gbuffer, *given) for name, engine in engines.items()}
    times = alternate(tasks, Pace(0.0, min_rounds=rounds))
    return {name: round(median(found["ms"]), 2) for name, found in times.items()}


def noise(bundle: Bundle, height: int, width: int) -> NDArray[np.float32]:
    """(N, C, height, width): a made-up G-buffer, the same each time, before the camera."""
    shape = 3 if bundle.per_channel else 1, bundle.channels, height, width
    gbuffer = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    if place := channel_slices(bundle.inputs, bundle.per_channel).get("position"):
        gbuffer[:, place.stop - 1] = -np.abs(gbuffer[:, place.stop - 1]) - 4
    return gbuffer


def bench(
    models: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of bundles; repeatable. Default: as 'deepshade serve'."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Two rounds instead of nine.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Time every bundle on every engine and precision here; * is what a request gets.

    Example: deepshade bench --json
    """
    import json as json_module

    from rich.table import Table

    from deepshade.console import stdout

    rounds = _QUICK_ROUNDS if quick else _ROUNDS
    rows: list[dict[str, Any]] = []
    for bundle in map(Bundle.load, bundle_folders(*bundle_roots(models or ()))):
        chosen = str(choose(bundle))
        for backend, ms in milliseconds(bundle, rounds).items():
            name = f"{bundle.effect}/{bundle.name}"
            rows.append({"bundle": name, "backend": backend, "ms": ms, "chosen": backend == chosen})
    if json:
        typer.echo(json_module.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    table = Table("bundle", "backend", f"ms at {WIDTH} x {HEIGHT}", title=describe())
    for row in rows:
        table.add_row(
            row["bundle"], row["backend"] + (" *" if row["chosen"] else ""), f"{row['ms']:.1f}"
        )
    stdout().print(table)
