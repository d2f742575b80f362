"""`deepshade train`, `search`, `evaluate` and `export`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

Effect = Annotated[str, typer.Argument(help="Effect to train, such as 'ao'.")]
Data = Annotated[list[Path], typer.Option(help="Data folder of 'deepshade datagen'; repeatable.")]


def train(
    effect: Effect,
    data: Data,
    out: Annotated[Path, typer.Option(help="Run folder; an existing run goes on.")],
    preset: Annotated[
        str, typer.Option(help="fast, balanced, best, paper or paper-network.")
    ] = "balanced",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change one setting: --set steps=4000; repeatable."),
    ] = None,
    device: Annotated[str, typer.Option(help="'cpu' or 'cuda'.")] = "cpu",
    threads: Annotated[int, typer.Option(help="CPU threads; 0 for all.", min=0)] = 0,
) -> None:
    """Train a shader. Ctrl-C saves and stops; the same command goes on.

    Examples:

    deepshade train ao --data data/ao --out runs/ao

    deepshade train ao --data data/ao --out runs/paper --preset paper --set steps=6000
    """
    import torch
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from deepshade_trainer.recipe import preset as load_preset
    from deepshade_trainer.run import Run
    from deepshade_trainer.training import train as steps

    if threads:
        torch.set_num_threads(threads)
    recipe = load_preset(preset, effect).changed(**_parse(settings or []))
    console = Console(stderr=True)
    columns = (
        TextColumn("training"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=recipe.steps, loss="")
        for progress in steps(recipe, data, Run(out), device=device):
            bar.update(task, completed=progress.step, loss=f"loss {progress.loss:.4f}")
            if progress.warning:
                console.print(progress.warning, style="yellow")
            if progress.figures:
                console.print(
                    f"step {progress.step}: loss {progress.loss:.4f}  held-out DSSIM "
                    f"{progress.figures['dssim']:.4f} ({progress.figures['ratio']:.3f} x all "
                    f"white)  MAE {progress.figures['mae']:.4f}"
                )
    typer.echo(f"the run is in {out}")


def search(
    effect: Effect,
    data: Data,
    out: Annotated[Path, typer.Option(help="Search folder; an existing search goes on.")],
    minutes: Annotated[float, typer.Option(help="Begin no trial after so long.", min=0)] = 60.0,
    steps: Annotated[int, typer.Option(help="Training steps of a first trial.", min=1)] = 400,
    most_ms: Annotated[
        float, typer.Option(help="Leave out networks slower than this at 768 x 512.", min=0)
    ] = 25.0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change one setting of the recipe: --set batch=4; repeatable."),
    ] = None,
    device: Annotated[str, typer.Option(help="'cpu' or 'cuda', for training.")] = "cpu",
    threads: Annotated[int, typer.Option(help="CPU threads; 0 for all.", min=0)] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the frontier as JSON.")] = False,
) -> None:
    """Search for networks that are faster or more accurate. Ctrl-C stops; the same command goes on.

    Each trial is trained a little and timed on this machine's fastest engine; those that no other
    one beats at their speed are trained three times longer, up to three times over.

    Examples:

    deepshade search ao --data data/ao --out runs/search --minutes 600
    """
    import torch
    from rich.console import Console
    from rich.table import Column, Table

    from deepshade.machine import cpu_count
    from deepshade_trainer.recipe import preset as load_preset
    from deepshade_trainer.search import frontier, label, read_trials
    from deepshade_trainer.search import search as trials

    if threads:
        torch.set_num_threads(threads)
    recipe = load_preset("balanced", effect).changed(**_parse(settings or []))
    console = Console(stderr=True)
    with console.status("searching") as status:
        found = trials(
            recipe,
            data,
            out,
            minutes=minutes,
            steps=steps,
            most_ms=most_ms,
            threads=threads or cpu_count(),
            device=device,
            report=lambda network, rung, progress: status.update(
                f"rung {rung}, {label(network)}: step {progress.step} of {progress.steps}"
            ),
        )
        for trial in found:
            console.print(
                f"rung {trial.rung}: {trial.ms:6.2f} ms  DSSIM {trial.dssim:.4f} "
                f"({trial.ratio:.3f} x all white)  {trial.label}"
            )
    best = frontier(read_trials(out / "trials.jsonl"))
    if as_json:
        typer.echo(json.dumps([asdict(trial) for trial in best], indent=2))
        return
    figures = ("ms at 768 x 512", "DSSIM", "x all white", "rung", "parameters")
    table = Table(*figures, Column("network", overflow="fold"))
    for trial in best:
        table.add_row(
            f"{trial.ms:.2f}",
            f"{trial.dssim:.4f}",
            f"{trial.ratio:.3f}",
            str(trial.rung),
            f"{trial.parameters:,}",
            trial.label,
        )
    Console().print(table)


def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, such as models/ao/balanced.")],
    data: Data,
    sheet: Annotated[Path | None, typer.Option(help="PNG contact sheet to write.")] = None,
    min_contrast: Annotated[
        float, typer.Option(help="Leave out views whose reference varies less.")
    ] = 0.12,
    limit: Annotated[int | None, typer.Option(help="Views at most.", min=1)] = None,
    half: Annotated[str, typer.Option(help="Attributes rounded to 16 bits, commas between.")] = "",
    scale: Annotated[float, typer.Option(help="Scale scene and radius by this.")] = 1.0,
    stretch: Annotated[
        float, typer.Option(help="Shorten normals at random by up to this share.", min=0, max=0.99)
    ] = 0.0,
    engine: Annotated[str, typer.Option(help="onnxruntime, openvino, …")] = "onnxruntime",
    precision: Annotated[str, typer.Option(help="fp32, bf16, fp16 or int8.")] = "fp32",
    card: Annotated[
        bool,
        typer.Option(
            "--card",
            help="Then measure every engine and precision here, on the last --data, and note it in "
            "the bundle's metrics and card for this kind of CPU.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Measure a bundle against references: SSIM, PSNR, MAE, FLIP of each view and the mean.

    Every figure stands beside that of the trivial answer (all white for ao) on the same views.

      deepshade evaluate models/ao/balanced --data data/test --sheet out/sheet.png

      deepshade evaluate models/ao/fast --data data/test --engine openvino --precision bf16

      deepshade evaluate models/ao/fast --data data/test --card
    """
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from deepshade import pictures
    from deepshade.bundles import Bundle
    from deepshade.engines import Backend
    from deepshade_trainer.card import measure_backends, refresh
    from deepshade_trainer.evaluation import Variant, contact_sheet, document, summary
    from deepshade_trainer.evaluation import evaluate as measure

    found = Bundle.load(bundle)
    variant = Variant(tuple(name for name in half.split(",") if name), scale, stretch)
    backend = Backend(engine, precision)
    noise = Console(stderr=True)
    shaded = measure(
        found, data, min_contrast=min_contrast, limit=limit, variant=variant, backend=backend
    )
    rows = list(track(shaded, "shading", console=noise, disable=not noise.is_terminal))
    if sheet is not None:
        pictures.save(sheet, contact_sheet(rows[:24]))
    if card:
        with noise.status("measuring every engine and precision"):
            refresh(found, lambda: measure_backends(found, data[-1]))
    if as_json:
        typer.echo(json.dumps(document(found, rows, variant, backend)))
        return
    shown = ("ssim", "psnr", "mae", "flip", "dssim", "trivial_dssim")
    listing = Table("scene", *shown)
    for row in rows:
        listing.add_row(row.scene, *(f"{row.figures[name]:.4f}" for name in shown))
    mean = summary(rows)
    listing.add_section()
    listing.add_row(f"mean of {len(rows)}", *(f"{mean[name]:.4f}" for name in shown))
    Console().print(listing)
    typer.echo(f"DSSIM is {mean['ratio']:.3f} x the trivial answer's, on {backend}")


def quantise(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, such as models/ao/balanced.")],
    data: Data,
) -> None:
    """Make a bundle's 8-bit graph anew, with the ranges that its numbers have on this data.

    `export` makes one already. What it takes and costs is then unknown until it is measured:
    deepshade evaluate models/ao/balanced --data data/test --card

      deepshade quantise models/ao/balanced --data data/mine
    """
    from deepshade.bundles import Bundle
    from deepshade_trainer.card import refresh
    from deepshade_trainer.quantisation import requantise

    found = Bundle.load(bundle)
    refresh(found, lambda: requantise(found, data))
    typer.echo(f"{bundle}: 8-bit graph made; next: deepshade evaluate {bundle} --card --data ...")


def export(
    run: Annotated[Path, typer.Argument(help="Run folder of 'deepshade train'.")],
    out: Annotated[Path, typer.Option(help="Bundle folder, such as models/ao/balanced.")],
    data: Annotated[
        list[Path], typer.Option(help="Data whose G-buffers prove parity; repeatable.")
    ],
    test: Annotated[
        list[Path] | None, typer.Option(help="Test data for the model card; repeatable.")
    ] = None,
    radius: Annotated[
        float, typer.Option(help="Effect radius of requests that name none, scene units.")
    ] = 1.0,
    note: Annotated[Path | None, typer.Option(help="Text that ends the model card.")] = None,
) -> None:
    """Write a bundle, prove that ONNX Runtime equals torch, and measure it for its card.

    deepshade export runs/ao --out models/ao/balanced --data data/ao --test data/test
    """
    from deepshade.errors import ConfigError
    from deepshade_trainer.card import measure, write_card
    from deepshade_trainer.export import export as write
    from deepshade_trainer.run import Run

    try:
        ending = note.read_text() if note else ""
    except OSError as error:
        raise ConfigError("note", detail=f"can't read {note}: {error.strerror}") from error
    bundle, worst = write(Run(run), out, data, radius=radius)
    if test:
        bundle = measure(bundle, test)
    write_card(bundle, Run(run), ending)
    typer.echo(f"{out}: sha256 {bundle.short_hash}, ONNX Runtime within {worst:.1e} of torch")


def _parse(settings: list[str]) -> dict[str, Any]:
    """`key=value` settings; values are JSON where they parse, `network.key` goes inside."""
    from deepshade.errors import ConfigError

    parsed: dict[str, Any] = {}
    for setting in settings:
        key, separator, text = setting.partition("=")
        if not separator:
            raise ConfigError(setting, detail=f"--set needs key=value, not {setting!r}")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        if key.startswith("network."):
            parsed.setdefault("network", {})[key.removeprefix("network.")] = value
        else:
            parsed[key] = value
    return parsed
