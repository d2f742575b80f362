"""`deepshade train`, `evaluate` and `export`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from deepshade_trainer.training import Progress

Effect = Annotated[str, typer.Argument(help="Effect to train, such as 'ao'.")]
Data = Annotated[list[Path], typer.Option(help="Data folder of 'deepshade datagen'; repeatable.")]


def train(
    effect: Effect,
    data: Data,
    out: Annotated[Path, typer.Option(help="Run folder; an existing run goes on.")],
    preset: Annotated[
        str,
        typer.Option(help="balanced, paper or paper-network; ao has fast, best and perceptrons."),
    ] = "balanced",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change one setting: --set steps=4000; repeatable."),
    ] = None,
    device: Annotated[str, typer.Option(help="'cpu' or 'cuda'.")] = "cpu",
    threads: Annotated[int, typer.Option(help="CPU threads; 0 for all.", min=0)] = 0,
) -> None:
    """Train a shader. Ctrl-C saves and stops, with exit code 130; the same command goes on.

    Examples:

    deepshade train ao --data data/ao --out runs/ao

    deepshade train ao --data data/mine --out runs/mine --set init_from=models/ao/balanced \
--set steps=60 --set warmup=6 --set lr=0.0008

    deepshade train ao --data data/ao --out runs/paper --preset paper --set steps=6000

    deepshade train ao --data data/cat --out runs/cat --preset mlp-16x8
    """
    import torch

    from deepshade.console import Watch
    from deepshade_trainer.recipe import preset as load_preset
    from deepshade_trainer.run import Run
    from deepshade_trainer.training import train as steps

    if threads:
        torch.set_num_threads(threads)
    recipe = load_preset(preset, effect).changed(**_parse(settings or []))
    done = recipe.steps  # a run that is complete yields nothing
    with Watch("training", "steps") as watch:
        for progress in steps(recipe, data, Run(out), device=device):
            done = progress.step
            if progress.warning:
                watch.say(progress.warning, "yellow")
            watch.update(done, recipe.steps, f"loss {progress.loss:.4f}" if done else "")
            if progress.figures:
                watch.say(_figures(progress))
    typer.echo(f"the run is in {out}")
    if done < recipe.steps:
        typer.echo(f"stopped at step {done} of {recipe.steps}; the same command goes on", err=True)
        raise typer.Exit(130)


def _figures(progress: Progress) -> str:
    """A validation in a line."""
    found = progress.figures or {}
    if "test_rmse" in found:
        return (
            f"step {progress.step}: error (RMSE) {found['rmse']:.4f} held out, "
            f"{found['test_rmse']:.4f} on the test, the mean answer's {found['trivial_rmse']:.4f}"
        )
    loss = f"loss {progress.loss:.4f}  " if progress.step else ""
    return (
        f"step {progress.step}: {loss}held-out DSSIM {found['dssim']:.4f} "
        f"({found['ratio']:.3f} x the trivial answer's)  MAE {found['mae']:.4f}"
    )


def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Bundle folder, such as models/ao/balanced.")],
    data: Data,
    sheet: Annotated[Path | None, typer.Option(help="PNG contact sheet to write.")] = None,
    min_contrast: Annotated[
        float | None,
        typer.Option(help="Leave out views that show less; by default as the effect's row says."),
    ] = None,
    limit: Annotated[int | None, typer.Option(help="Views at most.", min=1)] = None,
    half: Annotated[str, typer.Option(help="Attributes rounded to 16 bits, commas between.")] = "",
    scale: Annotated[float, typer.Option(help="Scale scene and radius by this.")] = 1.0,
    stretch: Annotated[
        float,
        typer.Option(help="Shorten directions at random by up to this share.", min=0, max=0.99),
    ] = 0.0,
    engine: Annotated[str, typer.Option(help="onnxruntime, openvino, …")] = "onnxruntime",
    precision: Annotated[str, typer.Option(help="fp32, bf16 or int8.")] = "fp32",
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Measure a bundle against references: SSIM, PSNR, MAE, FLIP of each view and the mean.

    Every figure stands beside that of the trivial answer (all white for ao) on the same views.

      deepshade evaluate models/ao/balanced --data data/test --sheet out/sheet.png

      deepshade evaluate models/ao/fast --data data/test --engine openvino --precision bf16
    """
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    from deepshade import pictures
    from deepshade.bundles import Bundle
    from deepshade.console import stdout
    from deepshade.effects import EFFECTS
    from deepshade.engines import Backend
    from deepshade_trainer.evaluation import Variant, contact_sheet, document, short_names, summary
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
        pictures.save(sheet, contact_sheet(EFFECTS[found.effect], rows[:24]))
    if as_json:
        typer.echo(json.dumps(document(found, rows, variant, backend)))
        return
    shown = ("ssim", "psnr", "mae", "flip", "dssim", "trivial_dssim")
    listing = Table("view", "scene", *shown)
    for row, scene in zip(rows, short_names([row.scene for row in rows]), strict=True):
        figures = (f"{row.figures[name]:.4f}" for name in shown)
        listing.add_row(str(row.number), scene, *figures)
    mean = summary(rows)
    listing.add_section()
    listing.add_row("mean", f"of {len(rows)} views", *(f"{mean[name]:.4f}" for name in shown))
    stdout().print(listing)
    typer.echo(f"DSSIM is {mean['ratio']:.3f} x the trivial answer's, on {backend}")


def export(
    run: Annotated[
        Path, typer.Argument(help="Run folder of 'deepshade train'; with --to, bundle folder.")
    ],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Bundle folder, models/ao/balanced say; with --to any."),
    ],
    data: Annotated[
        list[Path] | None, typer.Option(help="Data whose G-buffers prove parity; repeatable.")
    ] = None,
    test: Annotated[
        list[Path] | None, typer.Option(help="Test data for the model card; repeatable.")
    ] = None,
    radius: Annotated[
        float, typer.Option(help="Effect radius where a picture has no depth, scene units.")
    ] = 1.0,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change the network where no weights do: network.circle=0."),
    ] = None,
    note: Annotated[Path | None, typer.Option(help="Text that ends the model card.")] = None,
    to: Annotated[
        str, typer.Option(help="A bundle for another program: onnx, glsl, wgsl, hlsl or npz.")
    ] = "",
    size: Annotated[
        str, typer.Option(help="With --to: WxH in pixels, such as 768x512, or dynamic.")
    ] = "dynamic",
    opset: Annotated[int, typer.Option(help="With --to onnx: opset, 13 to 18.")] = 18,
    precision: Annotated[str, typer.Option(help="With --to onnx: fp32 or fp16.")] = "fp32",
    apart: Annotated[
        bool, typer.Option("--apart", help="With --to onnx: an input for each attribute.")
    ] = False,
) -> None:
    """Write a bundle, prove that ONNX Runtime equals torch, and measure it for its card.

    deepshade export runs/ao --out models/ao/balanced --data data/ao --test data/test

    With --to, write a bundle for a program of your own instead: a graph (docs/onnx.md), shaders
    (docs/shaders.md) or weights:

    deepshade export models/ao/fast --to onnx --size 768x512 -o graphs

    deepshade export models/ao/fast --to glsl --size 768x512 -o shaders
    """
    from functools import partial

    from deepshade.errors import ConfigError

    if to:
        from deepshade.bundles import Bundle
        from deepshade_trainer.formats import export_to

        export_to(Bundle.load(run), to, out, size, opset, precision, apart)
        return
    if not data:
        raise ConfigError("data", detail="name the data that it was trained on: --data data/ao")

    from deepshade_trainer.card import measure, write_card
    from deepshade_trainer.export import export as write
    from deepshade_trainer.run import Run

    try:
        ending = note.read_text() if note else ""
    except OSError as error:
        raise ConfigError("note", detail=f"can't read {note}: {error.strerror}") from error
    changes = _parse(settings or [])
    if set(changes) - {"network"}:
        raise ConfigError("set", detail="--set can change only network.… of a run that is trained")
    bundle, worst = write(Run(run), out, data, radius=radius, network=changes.get("network"))
    write_card(bundle, Run(run), ending)  # a bundle has one, whatever its measurement meets
    typer.echo(f"{out}: sha256 {bundle.short_hash}, ONNX Runtime within {worst:.1e} of torch")
    if test:
        tell = partial(typer.echo, err=True)
        write_card(measure(bundle, test, tell), Run(run), ending)
    else:
        typer.echo("not measured, as its card says: --test names views that it wasn't trained on")


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
