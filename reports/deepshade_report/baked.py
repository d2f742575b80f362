"""Ambient occlusion of a mesh that is known beforehand: baked, learnt by a perceptron, or shaded.

`python -m deepshade_report.baked MESH ... --out DIR` bakes each mesh to vertices and to texels,
trains its three perceptrons, and measures them and our networks that know no mesh on views that
none was made of. It prints the table of docs/perceptron.md and writes `sheet.png`; what DIR holds
already isn't made again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from deepshade import metrics, pictures, tensors
from deepshade.bundles import Bundle
from deepshade.cli import run
from deepshade.console import Watch
from deepshade.effects import EFFECTS
from deepshade.engines import REFERENCE, load_engine
from deepshade.errors import ConfigError
from deepshade.files import replacing, shipped
from deepshade.machine import cpu_count, describe
from deepshade.timing import Pace, alternate
from deepshade_report.baselines.ao import baking
from deepshade_trainer.export import export
from deepshade_trainer.presets.ao import PRESETS
from deepshade_trainer.recipe import preset
from deepshade_trainer.run import Run
from deepshade_trainer.training import train
from deepshade_workers.circles import view_around
from deepshade_workers.datagen import make_shard, open_manifest
from deepshade_workers.dataspec import DataSpec
from deepshade_workers.render import render_sample
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace

Float = NDArray[np.float32]
Images = dict[str, Float]

EFFECT = EFFECTS["ao"]
PERCEPTRONS = tuple(name for name in PRESETS if name.startswith("mlp-"))
CNNS = ("fast", "balanced")
TEXELS = 2**18  # as a texture of 512 x 512 with a byte each has
VIEWS, PIXELS = 128, 512  # the paper's, to learn from
_SHARD = 8
_TEST = 2**20  # seed of the views that are tested on


@dataclass(frozen=True)
class Method:
    """A way to shade a view: its bytes, and what it makes of a view (`Shot`)."""

    name: str
    size: int
    shade: Callable[[Shot], Float]


@dataclass(frozen=True)
class Shot:
    """A tested view: its images (C, H, W), and which places of the mesh its pixels see."""

    images: Images
    place: baking.Place
    radius: float

    @property
    def shown(self) -> NDArray[np.bool_]:
        """(H, W): where there is a surface."""
        found: NDArray[np.bool_] = np.asarray(self.images["normal_object"].any(0))
        return found


def shots(scene: Scene, count: int, size: int, spp: int) -> Iterator[Shot]:
    """Views from the same sphere, between those that were learnt from."""
    assert scene.mesh is not None
    for index in range(count):
        view = view_around(scene, index, _TEST, size, None)
        images = render_sample(
            scene,
            view,
            size,
            size,
            effects=[EFFECT.name],
            attributes=["normal_object"],
            samples=spp,
            seed=_TEST + index,
        )
        hits = trace(scene, view.camera, size, size)
        yield Shot(images, baking.places(scene.mesh, hits), view.radius)


def of_baked(name: str, made: baking.Vertices | baking.Texels) -> Method:
    """A lookup."""

    def shade(shot: Shot) -> Float:
        answer = np.ones(shot.shown.shape, np.float32)
        answer[shot.shown] = made.at(shot.place)
        return answer

    return Method(name, made.size, shade)


def of_bundle(name: str, bundle: Bundle) -> Method:
    """A network on the reference engine, in float32; its bytes are those of its weights."""
    from deepshade_trainer.networks import bundle_weights

    engine = load_engine(bundle, REFERENCE, threads=cpu_count())

    def shade(shot: Shot) -> Float:
        gbuffer = tensors.tensor(
            EFFECT,
            shot.images,
            bundle.inputs,
            shot.radius,
            per_channel=False,
            multiple=bundle.size_multiple,
        )
        height, width = shot.shown.shape
        answer: Float = engine.predict(gbuffer)[0, 0, :height, :width]
        return answer

    return Method(name, sum(4 * w.numel() for w in bundle_weights(bundle).values()), shade)


def learnt(mesh: Path, folder: Path, hidden: bool) -> Path:
    """The mesh's samples, in `folder`/data."""
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    spec = DataSpec((str(mesh),), VIEWS, size=512, frame=512, pixels=PIXELS, shard_size=_SHARD)
    manifest = open_manifest(spec, data)
    first = len(manifest.shards)  # they come in order
    done = iter(range(first * _SHARD + 1, VIEWS + 1))
    with Watch(f"{mesh.stem}: sampling", "views", hidden=hidden) as watch:
        for index in range(first, spec.shards):
            shard = make_shard(spec, index, data, lambda: watch.update(next(done), VIEWS))
            manifest = manifest.with_shard(shard)
            manifest.write(data)
    return data


def perceptrons(mesh: Path, folder: Path, hidden: bool) -> Iterator[Method]:
    """The mesh's three perceptrons, at 10 pixels and at 0, trained where they aren't yet."""
    data = learnt(mesh, folder, hidden)
    for name in PERCEPTRONS:
        trained = Run(folder / name)
        with Watch(f"{mesh.stem}: {name}", "steps", hidden=hidden) as watch:
            for step in train(preset(name, EFFECT.name), [data], trained):
                watch.update(step.step, step.steps)
        for circle in (10, 0):
            target = folder / EFFECT.name / f"{name}-{circle}"
            bundle, _ = export(trained, target, [data], network={"circle": circle})
            yield of_bundle(f"perceptron {name.removeprefix('mlp-')}, {circle} px", bundle)


def methods(mesh: Path, folder: Path, models: Path, spp: int, hidden: bool) -> list[Method]:
    """All ways for a mesh, baked and trained where they aren't yet."""
    scene = open_scene(str(mesh))
    view = view_around(scene, 0, 0, 64, None)
    found = [
        of_baked("vertices", baking.bake_vertices(scene, view, spp, 1)),
        of_baked("texels", baking.bake_texels(scene, view, TEXELS, spp, 2)),
        *perceptrons(mesh, folder, hidden),
    ]
    return found + [
        of_bundle(f"CNN {EFFECT.name}/{name}", Bundle.load(models / EFFECT.name / name))
        for name in CNNS
    ]


def measured(
    found: Sequence[Method], views: Sequence[Shot], rounds: int
) -> tuple[list[dict[str, Any]], pictures.Picture]:
    """A row a method, the trivial answer's first, and the first view by all of them.

    DSSIM is of the whole picture, the mean error of the pixels that show the mesh.
    """
    blank = Method("white", 0, lambda shot: np.ones(shot.shown.shape, np.float32))
    tasks = {m.name: (lambda m=m: m.shade(views[0])) for m in found}
    times = alternate(tasks, Pace(0.0, min_rounds=rounds))
    rows, sheet = [], [pictures.shading(views[0].images[f"reference_{EFFECT.name}"])]
    for method in (blank, *found):
        dssim, mae = [], []
        for shot in views:
            truth, answer = shot.images[f"reference_{EFFECT.name}"][0], method.shade(shot)
            dssim.append(metrics.dssim(answer, truth))
            mae.append(float(np.abs(answer - truth)[shot.shown].mean()))
        ms = median(times[method.name]["ms"]) if method.name in times else None
        rows.append(
            {
                "method": method.name,
                "bytes": method.size,
                "dssim": float(np.mean(dssim)),
                "mae": float(np.mean(mae)),
                "ms": ms,
            }
        )
        if method is not blank:
            sheet.append(pictures.shading(method.shade(views[0])[None]))
    return rows, pictures.beside(sheet)


def table(results: dict[str, dict[str, Any]]) -> list[str]:
    """A row a method: bytes, DSSIM and mean error of each mesh, and the mean milliseconds."""
    meshes = list(results)
    lines = [
        f"| | {' | '.join(f'{m}: bytes, DSSIM, MAE' for m in meshes)} | ms |",
        "|---" * (len(meshes) + 2) + "|",
    ]
    for k, row in enumerate(results[meshes[0]]["rows"]):
        cells, times = [], []
        for mesh in meshes:
            own = results[mesh]["rows"][k]
            cells.append(f"{own['bytes']:,} .{own['dssim'] * 1e4:04.0f} .{own['mae'] * 1e4:04.0f}")
            times.append(own["ms"])
        ms = "" if row["ms"] is None else f"{np.mean(times):.1f}"
        lines.append(f"| {row['method']} | {' | '.join(cells)} | {ms} |")
    return lines


def main(
    meshes: Annotated[list[Path], typer.Argument(help="OBJ, PLY, glTF or GLB files.")],
    out: Annotated[Path, typer.Option(help="Folder of what is made.")],
    models: Annotated[
        Path | None, typer.Option(help="Folder of the CNNs. Default: those that ship.")
    ] = None,
    views: Annotated[int, typer.Option(help="Views to test on.", min=1)] = 6,
    size: Annotated[int, typer.Option(help="Side of a tested view, pixels.", min=32)] = 512,
    spp: Annotated[int, typer.Option(help="Rays of a baked place or a pixel.", min=2)] = 256,
    rounds: Annotated[int, typer.Option(help="Of timing.", min=1)] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Bake, train and measure; minutes a mesh."""
    names = [mesh.stem for mesh in meshes]
    if len(set(names)) < len(names):
        raise ConfigError("meshes", detail="two meshes of one name would share their results")
    results: dict[str, dict[str, Any]] = {}
    sheet = []
    settings = {"views": views, "size": size, "spp": spp}
    for mesh, name in zip(meshes, names, strict=True):
        known = out / f"{name}.json"
        told = json.loads(known.read_text("utf-8")) if known.exists() else {}
        if told.get("settings") != settings or not known.with_suffix(".png").exists():
            ways = methods(mesh, out / name, models or shipped("models"), spp, as_json)
            seen = list(shots(open_scene(str(mesh)), views, size, spp))
            rows, picture = measured(ways, seen, rounds)
            pictures.save(known.with_suffix(".png"), picture)
            told = {"settings": settings, "machine": describe(), "rows": rows}
            with replacing(known) as part:
                part.write_text(json.dumps(told, indent=1), "utf-8")
        results[name] = told
        sheet.append(known.with_suffix(".png"))
    if as_json:
        typer.echo(json.dumps(results))
        return
    typer.echo("\n".join(table(results)))
    typer.echo(
        f"pictures: {', '.join(map(str, sheet))}: reference, then the table's rows but white"
    )


if __name__ == "__main__":
    app = typer.Typer()
    app.command()(main)
    sys.exit(run(typer.main.get_command(app), name="python -m deepshade_report.baked"))
