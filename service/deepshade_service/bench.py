"""`deepshade bench`: every bundle on every engine and precision of this machine."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from deepshade.bundles import Bundle
    from deepshade_service.calibration import Calibration

_SIZE = (768, 512)


def bench(
    effect: Annotated[str | None, typer.Argument(help="Only this effect.")] = None,
    bundle: Annotated[str | None, typer.Option(help="Only the bundle of this name.")] = None,
    models: Annotated[Path | None, typer.Option(help="Folder of bundles.")] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="Measure all anew and keep it, for the service.")
    ] = False,
    calibration: Annotated[
        str, typer.Option(help="File to keep it in, as for 'deepshade serve'.")
    ] = "",
    threads: Annotated[
        int | None, typer.Option(min=1, help="Default: the CPUs we may use.")
    ] = None,
    device: Annotated[
        bool,
        typer.Option(
            "--device",
            help="Also time ONNX Runtime with the pixels already on the device: for GPUs.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure what each engine and precision takes, and what it costs in error.

    Shows what is known and measures what isn't, without keeping it; --calibrate measures
    everything and keeps it. The service does the same in the background at its first start.
    Leave the machine alone meanwhile.

      deepshade bench ao --calibrate
    """
    from rich.console import Console

    from deepshade.bundles import Bundle, bundle_folders, bundle_root
    from deepshade.errors import ConfigError
    from deepshade.machine import cpu_count, describe
    from deepshade_service.calibration import Calibration, chosen_path

    root = models or bundle_root()
    found = [
        Bundle.load(folder)
        for folder in bundle_folders(root)
        if effect in (None, folder.parent.name) and bundle in (None, folder.name)
    ]
    if not found:
        raise ConfigError("bundle", detail=f"no such bundle under {root}")
    path = chosen_path(calibration)
    if calibrate and path is None:
        raise ConfigError("calibration", detail="--calibrate needs a file to keep its results in")
    threads = threads or cpu_count()
    results = Calibration(path, threads=threads)
    if not calibrate:
        results.path = None  # look at what there is, but keep nothing
    noise = Console(stderr=True)
    rows = []
    for one in found:
        _measure(one, results, calibrate, noise)
        rows += _rows(one, results)
        if device:
            _add_device_times(one, rows, threads)
    if as_json:
        document = {"machine": describe(), "threads": threads, "size": _SIZE, "backends": rows}
        typer.echo(json.dumps(document, indent=1))
        return
    _show(rows)
    typer.echo(f"{describe()}, {threads} threads; 'ms' at {_SIZE[0]} x {_SIZE[1]}")
    if calibrate:
        typer.echo(f"kept in {path}")


def _measure(bundle: Bundle, results: Calibration, anew: bool, noise: Any) -> None:
    from deepshade.engines import usable

    text = f"measuring {bundle.effect}/{bundle.name} on every engine and precision"
    with noise.status(text) if noise.is_terminal else nullcontext():
        results.measure(bundle, usable(bundle) if anew else results.missing(bundle))


def _rows(bundle: Bundle, results: Calibration) -> list[dict[str, Any]]:
    from deepshade_service.candidate import fastest

    known = results.all(bundle)
    chosen = fastest(known)
    pixels = _SIZE[0] * _SIZE[1]
    return [
        {
            "effect": bundle.effect,
            "bundle": bundle.name,
            "sha256": bundle.sha256,
            "engine": found.backend.engine,
            "precision": found.backend.precision,
            "ms": round(found.ms(pixels), 3),
            "fixed_ms": round(found.fixed_ms, 3),
            "ms_per_megapixel": round(found.ms_per_megapixel, 3),
            "dssim": found.dssim,
            "added": found.added,
            "default": found.backend == chosen,
        }
        for found in sorted(known, key=lambda found: found.ms(pixels))
    ]


def _add_device_times(bundle: Bundle, rows: list[dict[str, Any]], threads: int) -> None:
    """`device_ms` of each row of the bundle, None on engines that can't tell."""
    import numpy as np

    from deepshade.engines import Backend, load_engine
    from deepshade_service.tiles import padded

    height, width = padded(_SIZE[1], _SIZE[0], bundle.size_multiple)
    for row in rows:
        if row["sha256"] == bundle.sha256:
            backend = Backend(row["engine"], row["precision"])
            engine = load_engine(bundle, backend, threads=threads)
            gbuffer = np.full((1, engine.channels, height, width), -0.5, np.float32)
            row["device_ms"] = engine.device_ms(gbuffer)


def _show(rows: list[dict[str, Any]]) -> None:
    from rich.table import Table

    from deepshade.console import stdout

    columns = ["bundle", "engine", "precision", "ms", "fixed ms", "ms/Mpx", "DSSIM", "added"]
    on_device = any("device_ms" in row for row in rows)
    table = Table(*columns, *(["device ms"] if on_device else []), "")
    for row in rows:
        dssim = "unknown" if row["dssim"] is None else f"{row['dssim']:.4f}"
        added = "unknown" if row["added"] is None else f"{100 * row['added']:+.2f} %"
        table.add_row(
            f"{row['effect']}/{row['bundle']}",
            row["engine"],
            row["precision"],
            f"{row['ms']:.1f}",
            f"{row['fixed_ms']:.1f}",
            f"{row['ms_per_megapixel']:.1f}",
            dssim,
            added,
            *([_device(row)] if on_device else []),
            "default" if row["default"] else "",
        )
    stdout().print(table)


def _device(row: dict[str, Any]) -> str:
    return "" if row["device_ms"] is None else f"{row['device_ms']:.2f}"
