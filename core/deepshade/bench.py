"""`deepshade bench`: milliseconds of every bundle on every engine and precision of this machine."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer

from deepshade.bundles import Bundle, bundle_folders, bundle_roots
from deepshade.engines import choose, load_engine, usable
from deepshade.environments import black
from deepshade.machine import cpu_count, describe
from deepshade.tensors import channel_slices, up

WIDTH, HEIGHT = 768, 512  # the paper's frame
_ROUNDS = 9


def milliseconds(bundle: Bundle) -> dict[str, float]:
    """Median milliseconds of the bare network at 768 x 512, by backend; all take turns.

    All three runs of a network that runs once a colour channel. Input is ready, and noise.
    """
    rows, columns = up(HEIGHT, bundle.size_multiple), up(WIDTH, bundle.size_multiple)
    shape = 3 if bundle.per_channel else 1, bundle.channels, rows, columns
    gbuffer = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    if place := channel_slices(bundle.inputs, bundle.per_channel).get("position"):
        gbuffer[:, place.stop - 1] = -np.abs(gbuffer[:, place.stop - 1]) - 4
    engines = {str(b): load_engine(bundle, b, threads=cpu_count()) for b in usable(bundle)}
    given = (black(bundle.environment),) if bundle.environment else ()
    times: dict[str, list[float]] = {name: [] for name in engines}
    for turn in range(_ROUNDS + 2):
        for name, engine in engines.items():
            start = time.perf_counter()
            engine.predict(gbuffer, *given)
            if turn > 1:
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: round(median(taken), 2) for name, taken in times.items()}


def bench(
    models: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of bundles; repeatable. Default: as 'deepshade serve'."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Time every bundle on every engine and precision here; * is what a request gets.

    Example: deepshade bench --json
    """
    import json as json_module

    from rich.table import Table

    from deepshade.console import stdout

    rows: list[dict[str, Any]] = []
    for bundle in map(Bundle.load, bundle_folders(*bundle_roots(models or ()))):
        chosen = str(choose(bundle))
        for backend, ms in milliseconds(bundle).items():
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
