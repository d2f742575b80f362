"""Every export of every bundle on one picture: how far each answer lies from the bundle's own.

`python -m deepshade_report.exports GBUFFER --out DIR` measures, one bundle after another, what DIR
doesn't know yet; with all of them known it prints the table of docs/shaders.md and writes
`sheet.png`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from deepshade import pictures, tensors
from deepshade.bundles import Bundle, bundle_folders
from deepshade.camera import camera_to_world
from deepshade.cli import run
from deepshade.effects import EFFECTS
from deepshade.environments import Prepared, sky
from deepshade.errors import ConfigError, EngineError
from deepshade.files import replacing
from deepshade.gbuffer import load_gbuffer
from deepshade_report import programs
from deepshade_trainer.graph import session
from deepshade_trainer.interchange import Size, facts, plain, write_plain
from deepshade_trainer.shaders import write_shaders
from deepshade_trainer.shaders.lowering import lower

Float = NDArray[np.float32]
_RUNNERS: dict[str, tuple[str, Callable[[Path], programs.Runner]]] = {
    "GLSL compute": ("glsl", programs.GlCompute),
    "GLSL fragment": ("glsl", programs.GlFragment),
    "WGSL": ("wgsl", programs.WebGpu),
    "HLSL": ("hlsl", programs.Hlsl),
}
COLUMNS = ("ONNX", "ONNX, one size", "ONNX, fp16", *_RUNNERS)


def given_of(bundle: Bundle, picture: Path) -> dict[str, Float]:
    """What a bundle's graph takes, of a rendered view: its sides padded, a sky around."""
    loaded = load_gbuffer(picture, bundle.inputs)
    effect = EFFECTS[bundle.effect]
    radius = float(loaded.header.get("deepshade:radius", 1.0))
    array = tensors.tensor(
        effect,
        loaded.attributes,
        bundle.inputs,
        radius,
        per_channel=False,
        multiple=bundle.size_multiple,
    )
    given = {bundle.input_name: array}
    if bundle.environment:
        prepared = Prepared.of(sky(height=64))
        turned = camera_to_world(loaded.attributes, loaded.camera)
        given |= prepared.inputs(bundle.environment, 0.0, "y", lambda: turned)
    return given


def answers(bundle: Bundle, given: Mapping[str, Float], work: Path) -> Iterator[tuple[str, Float]]:
    """(export, its answer) of each of COLUMNS, that of the bundle itself first, as "bundle".

    One that there is not for a bundle, as fp16 where all needs float32, is left out.
    """
    height, width = given[bundle.input_name].shape[2:]
    size: Size = (width, height)
    yield "bundle", session(bundle.model).run(None, dict(given))[0]
    for name, sides in (("ONNX", None), ("ONNX, one size", size)):
        yield name, session(write_plain(bundle, work, sides).path).run(None, dict(given))[0]
    try:
        half = write_plain(bundle, work, size, precision="fp16").path
        yield "ONNX, fp16", session(half).run(None, dict(given))[0]
    except ConfigError:
        pass
    program = lower(plain(bundle, size)).shared()
    for name, (language, runner) in _RUNNERS.items():
        folder = work / f"{bundle.effect}-{bundle.name}-{language}"
        write_shaders(program, language, folder, facts(bundle))
        yield name, runner(folder).answer(given)


def measured(bundle: Bundle, picture: Path, out: Path) -> dict[str, Any]:
    """The largest and mean difference of each export, and its answer in `out` as .npy.

    Differences are of values over 1 relative.
    """
    found: dict[str, Any] = {}
    theirs: Float | None = None
    work = out / "work"
    for name, answer in answers(bundle, given_of(bundle, picture), work):
        np.save(out / f"{bundle.effect}-{bundle.name}-{name.replace(' ', '_')}.npy", answer)
        if theirs is None:
            theirs = answer
            continue
        apart = np.abs(answer - theirs) / np.maximum(1, np.abs(theirs))
        found[name] = {"largest": float(apart.max()), "mean": float(apart.mean())}
    return found


def table(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The largest differences, a row a bundle."""
    lines = [f"| bundle | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, found in results.items():
        largest = [found[each]["largest"] if each in found else None for each in COLUMNS]
        cells = ["" if each is None else f"{each:.0e}" if each else "0" for each in largest]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def sheet(names: Sequence[str], out: Path) -> pictures.Picture:
    """A row a bundle: its own answer, then each export's, all exposed as the first needs it."""
    stems = [name.replace("/", "-") for name in names]
    width = min(np.load(out / f"{stem}-bundle.npy").shape[3] for stem in stems)  # as padded
    rows = []
    for name in names:
        effect, stem = EFFECTS[name.partition("/")[0]], name.replace("/", "-")
        own = np.load(out / f"{stem}-bundle.npy")[0]
        high = max(float(np.quantile(own, 0.99)), 1e-6) if effect.is_light else 1.0
        row = [own]
        for column in COLUMNS:
            path = out / f"{stem}-{column.replace(' ', '_')}.npy"
            row.append(np.load(path)[0] if path.exists() else np.full_like(own, high))
        shown = [pictures.of_effect(each[:, :, :width] / high, effect) for each in row]
        rows.append(np.concatenate(shown, 1))
    return np.concatenate(rows)


def main(
    gbuffer: Annotated[Path, typer.Argument(help="An EXR of 'deepshade render', all attributes.")],
    out: Annotated[Path, typer.Option(help="Folder of what was measured.")],
    models: Annotated[Path, typer.Option(help="Folder of the bundles.")] = Path("models"),
    limit: Annotated[int, typer.Option(help="Bundles to measure in this run at most.")] = 100,
) -> None:
    """Shade a picture by every export of every bundle."""
    out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    for folder in bundle_folders(models):
        bundle = Bundle.load(folder)
        name = f"{bundle.effect}/{bundle.name}"
        known = out / f"{bundle.effect}-{bundle.name}.json"
        if not known.exists():
            if not limit:
                continue
            limit -= 1
            found = measured(bundle, gbuffer, out)
            with replacing(known) as part:
                part.write_text(json.dumps(found), "utf-8")
            typer.echo(f"{name}: " + ", ".join(f"{k} {v['largest']:.0e}" for k, v in found.items()))
        results[name] = json.loads(known.read_text("utf-8"))
    if len(results) < len(bundle_folders(models)):
        raise EngineError("not all bundles are measured yet", fix="run the same command again")
    pictures.save(out / "sheet.png", sheet(list(results), out))
    typer.echo("\n".join(table(results)))


if __name__ == "__main__":
    app = typer.Typer()
    app.command()(main)
    sys.exit(run(typer.main.get_command(app), name="python -m deepshade_report.exports"))
