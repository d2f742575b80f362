"""Flicker of every method over short paths: of the camera, and of an object before it.

Views are a data set's own, their scenes rendered again, frame by frame. Each pixel's surface is
followed into the next frame; where it is seen there too, the answer's change along with it is held
against the reference's. `flicker` is the mean of what the answer changes more than the reference,
of white. Our answers come once more as `--history` of a live session leaves them. Prints JSON, one
line a path and method, the worst first.

    python benchmarks/flicker.py ao --data data/test-ao
    python benchmarks/flicker.py mb --data data/test-lens --views 1 --frames 3 --size 96
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import metrics
from deepshade.bundles import bundle_root
from deepshade.effects import EFFECTS
from deepshade.environments.stored import surroundings_of
from deepshade.errors import DeepshadeError
from deepshade.gbuffer import GBuffer
from deepshade.gbuffer.background import remove
from deepshade.manifest import Manifest
from deepshade.tensors import median_depth
from deepshade_report.context import Context
from deepshade_report.method import Network
from deepshade_report.sections.methods import methods, shaded
from deepshade_report.view import Float, View
from deepshade_service.live.history import History
from deepshade_workers.records import view_of
from deepshade_workers.render import render_sample
from deepshade_workers.scenes.loading import open_scene
from deepshade_workers.scenes.scene import Scene
from deepshade_workers.trace import trace

STEP = 1.3  # pixels that the middle of the picture moves from frame to frame
SAME = 0.02  # of its depth, by which a followed point may miss the surface there


@dataclass(frozen=True)
class Frame:
    """A rendered frame: its view, and where each pixel's surface stands in the world."""

    view: View
    world: Float  # (3, H, W)
    moves: Float  # (3, H, W): how far that surface is moved by the next frame


def paths(folder: Path, effect: str, views: int, frames: int, size: int, samples: int) -> Any:
    """(name, frames) of a camera's and an object's path, for views of different scenes first."""
    manifest = Manifest.read(folder)
    records = [record for shard in manifest.shards for record in shard.samples]
    first = {record["scene"]: record for record in reversed(records)}
    chosen = [*first.values(), *(r for r in records if r not in first.values())][:views]
    for record in chosen:
        scene = open_scene(record["scene"])
        seen = view_of(record, scene, folder)
        camera = replace(seen.camera, width=size, height=size, x0=0, y0=0)
        seen = replace(seen, camera=camera)
        hits = trace(scene, camera, size, size)
        depth = float(np.median(hits.depth.numpy()[hits.valid.numpy()]))
        step = STEP * depth / camera.pixels_per_unit
        along = camera.matrix[:3, :3].T @ np.array([step, 0.3 * step, 0])
        name = f"{Path(record['scene']).stem}"
        made = (record, seen, samples, folder)

        def shot(scene: Scene, view: Any, moved: Any, number: int, made: Any = made) -> Frame:
            return _frame(scene, view, moved, EFFECTS[effect], *made)

        still = np.zeros((3, size, size), np.float32)
        yield (
            f"{name}, camera",
            [shot(scene, _shifted(seen, -along * k), still, k) for k in range(frames)],
        )
        item = _object(scene, hits, size)
        if item is not None:
            shots = []
            for k in range(frames):
                part = _moved(scene, item, along * k)
                moves = _moving(part, item, seen, along, size)
                shots.append(shot(part, seen, moves, k))
            yield f"{name}, object {item.name}", shots


def flicker(frames: list[Frame], answers: list[Float], exposure: float) -> float:
    """The mean of what answers change more along with surfaces than references, of white."""
    excess: list[Float] = []
    for (one, ours), (other, theirs) in zip(
        zip(frames, answers, strict=True), list(zip(frames, answers, strict=True))[1:], strict=False
    ):
        rows, columns, seen = _follow(one, other)
        changes = [
            np.abs(_looked(after, rows, columns) - before)[:, seen]
            for before, after in (
                (ours, theirs),
                (one.view.reference, other.view.reference),
            )
        ]
        excess.append(np.maximum(changes[0] - changes[1], 0) * exposure)
    return float(np.mean([np.minimum(each, 1).mean() for each in excess]))


def _frame(
    scene: Scene,
    view: Any,
    moves: Any,
    effect: Any,
    record: Any,
    _: Any,
    samples: int,
    folder: Path,
) -> Frame:
    size = view.camera.width
    images = render_sample(
        scene,
        view,
        size,
        size,
        effects=[effect.name],
        attributes=["position"],
        samples=samples,
        seed=int(record["seed"]) % 2**31,
    )
    beside = effect.trivial_layer
    planes = {n: images[n] for n in {*effect.inputs, "position"} | ({beside} & images.keys())}
    reference = images[f"reference_{effect.name}"]
    known = {name: planes[name] for name in planes if not name.startswith("reference")}
    background, _ = remove(known, list(known))
    radius = view.radius or median_depth(planes) or 1.0
    turn = view.camera.matrix
    world = np.tensordot(turn[:3, :3].T, planes["position"] - turn[:3, 3, None, None], 1)
    around = surroundings_of(folder, record) if "environment" in record else None
    made = View(
        str(record["scene"]),
        effect,
        planes,
        background,
        reference,
        radius,
        view.camera,
        dict(record),
        None,
        around,
    )
    return Frame(made, np.where(background, np.nan, world).astype(np.float32), moves)


def _shifted(view: Any, by: Any) -> Any:
    """The view, its camera moved in the world."""
    matrix = view.camera.matrix.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ by
    return replace(view, camera=replace(view.camera, world_to_camera=matrix))


def _object(scene: Scene, hits: Any, size: int) -> Any:
    """The object that covers most of the picture but a third at most; None where there is none."""
    numbers = _numbers(scene, hits, size)
    sizes = {k: int((numbers == k).sum()) for k in np.unique(numbers[numbers >= 0]).tolist()}
    fitting = [k for k, count in sizes.items() if 0.005 < count / numbers.size < 0.33]
    if not fitting or scene.mesh is None or len(sizes) < 2:
        return None
    best = max(fitting, key=lambda k: sizes[k])
    return scene.objects[best]


def _numbers(scene: Scene, hits: Any, size: int) -> NDArray[np.int64]:
    """(H, W): which object is seen, -1 where none is."""
    import mitsuba as mi

    found = hits.surface.shape.eval_attribute_1("face_object", hits.surface)
    numbers = mi.Float(found).numpy().reshape(size, size).round().astype(np.int64)
    return np.where(hits.valid.numpy().reshape(size, size), numbers, -1)


def _moved(scene: Scene, item: Any, by: Any) -> Scene:
    """The scene with one of its objects elsewhere."""
    mesh = scene.mesh
    assert mesh is not None
    faces = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
    vertices[3 * item.start : 3 * item.stop] += by
    return Scene.from_mesh(scene.name, replace(mesh, vertices=vertices, faces=faces))


def _moving(scene: Scene, item: Any, view: Any, by: Any, size: int) -> Float:
    """(3, H, W): how far what each pixel shows is moved by the next frame."""
    numbers = _numbers(scene, trace(scene, view.camera, size, size), size)
    seen = numbers == [one.name for one in scene.objects].index(item.name)
    return (seen * np.asarray(by)[:, None, None]).astype(np.float32)


def _follow(one: Frame, other: Frame) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Where each pixel's surface lies in the other frame: row, column, and whether it is seen."""
    camera = other.view.camera
    place = one.world + one.moves
    p = np.tensordot(camera.matrix[:3, :3], place, 1) + camera.matrix[:3, 3, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        column = p[0] / -p[2] * camera.pixels_per_unit + camera.width / 2 - 0.5
        row = camera.height / 2 - p[1] / -p[2] * camera.pixels_per_unit - 0.5
        seen = np.isfinite(column) & (p[2] < 0)
        seen &= (column >= 0) & (column <= camera.width - 1)
        seen &= (row >= 0) & (row <= camera.height - 1)
    row, column = np.where(seen, row, 0), np.where(seen, column, 0)
    there = other.world + 0  # the surface that is seen at the nearest pixel
    there = there[:, row.round().astype(int), column.round().astype(int)]
    miss = np.sqrt(((there - place) ** 2).sum(0))
    with np.errstate(invalid="ignore"):
        seen &= miss < SAME * -p[2]
    return row.astype(np.float32), column.astype(np.float32), seen


def _looked(image: Float, row: Float, column: Float) -> Float:
    """(C, H, W): an image (C, H, W) bilinearly at places (H, W)."""
    top = np.clip(row.astype(int), 0, image.shape[1] - 2)
    left = np.clip(column.astype(int), 0, image.shape[2] - 2)
    y, x = row - top, column - left
    upper = image[:, top, left] * (1 - x) + image[:, top, left + 1] * x
    lower = image[:, top + 1, left] * (1 - x) + image[:, top + 1, left + 1] * x
    return np.asarray(upper * (1 - y) + lower * y, np.float32)


def _kept(effect: str, frames: list[Frame], answers: list[Float]) -> list[Float]:
    """Answers as a live session with `--history`, but without a motion pass, would send them."""
    history, kept = History(), []
    for frame, answer in zip(frames, answers, strict=True):
        view = frame.view
        known = {name: view.attributes[name] for name in view.effect.inputs}
        gbuffer = GBuffer(known, view.background, view.camera)
        kept.append(history.blend(effect, answer, gbuffer, None, alone=False))
    return kept


def measure(
    effect: str, folder: Path, models: Path, views: int, frames: int, size: int, samples: int
) -> Iterator[dict[str, Any]]:
    """A row for each path and method."""
    context = Context([models], folder, Path("out"), effect=effect, quick=True)
    found, missing = methods(context)
    # what traces rays needs the scene as the data set has it, not as a path has moved it
    found = {name: each for name, each in found.items() if not getattr(each, "needs_scene", False)}
    for why in missing.values():
        print(why, file=sys.stderr)
    for path, shots in paths(folder, effect, views, frames, size, samples):
        reference = shots[0].view.reference
        exposure = metrics.exposure(reference) if EFFECTS[effect].is_light else 1.0
        for name, method in found.items():
            answers = []
            try:
                for shot in shots:
                    method.prepare(shot.view)
                    answers.append(np.asarray(shaded(method, shot.view)).reshape(reference.shape))
            except (DeepshadeError, KeyError) as problem:
                print(f"{name}: {problem}", file=sys.stderr)
                continue
            series = {name: answers}
            if isinstance(method, Network) and EFFECTS[effect].history:
                series[f"{name}, history"] = _kept(effect, shots, answers)
            for title, shown in series.items():
                errors = [s.view.dssim(a) for s, a in zip(shots, shown, strict=True)]
                yield {
                    "effect": effect,
                    "path": path,
                    "method": title,
                    "family": method.family,
                    "flicker": flicker(shots, shown, exposure),
                    "dssim": float(np.mean(errors)),
                }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("effect", choices=EFFECTS)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--models", type=Path, default=bundle_root())
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--samples", type=int, default=256)
    asked = vars(parser.parse_args())
    asked["folder"] = asked.pop("data")
    rows = sorted(measure(**asked), key=lambda row: -row["flicker"])
    for row in rows:
        print(json.dumps(row))
    if not rows or math.isnan(rows[0]["flicker"]):
        sys.exit(1)
