"""Reads the views of a data set that show something."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.camera import Camera
from deepshade.errors import DataError
from deepshade.files import sha256
from deepshade.manifest import Manifest, Shard, shard_path
from deepshade_report.method import View

MIN_CONTRAST = 0.12  # standard deviation of the reference below which a view shows too little


def load_views(
    folder: Path,
    effect: str = "ao",
    limit: int | None = None,
    *,
    min_contrast: float = MIN_CONTRAST,
    keep: range | None = None,
) -> list[View]:
    """The views of a data set whose reference has at least `min_contrast`, in their order.

    At most `limit` of them; `keep` are the numbers of the samples to look at, all by default.

    Raises:
        DataError: `folder` holds no such data set, a shard is damaged, or no view shows enough.
    """
    found: list[View] = []
    for view in _views(folder, effect, keep):
        if float(view.reference.std()) >= min_contrast:
            found.append(view)
            if len(found) == limit:
                break
    if not found:
        raise DataError(
            f"no view of {folder} has a contrast of {min_contrast}",
            fix="render views that show more: deepshade datagen --min-contrast",
        )
    return found


def _views(folder: Path, effect: str, keep: range | None) -> Iterator[View]:
    manifest = Manifest.read(folder)
    needed = {"normal", "position", f"reference_{effect}"}
    missing = needed - set(manifest.schema)
    if missing:
        raise DataError(
            f"{folder} has no {', '.join(sorted(missing))}",
            fix=f"render it with --effects {effect}",
        )
    first = 0
    for shard in manifest.shards:
        numbers = range(first, first + len(shard.samples))
        first = numbers.stop
        wanted = [n - numbers.start for n in numbers if keep is None or n in keep]
        if wanted:
            yield from _of_shard(folder, shard, effect, wanted)


def _of_shard(folder: Path, shard: Shard, effect: str, wanted: list[int]) -> Iterator[View]:
    from safetensors import safe_open

    path = shard_path(folder, shard)
    if not path.is_file():
        raise DataError(f"{path} is named by the manifest but missing")
    if sha256(path) != shard.sha256:
        raise DataError(
            f"{path} is not the file that the manifest describes",
            fix="run the same 'deepshade datagen' again: it renders what is damaged",
        )
    try:
        with safe_open(path, framework="numpy") as file:
            for index in wanted:
                tensors = {
                    name: file.get_slice(name)[index].astype(np.float32)
                    for name in ("normal", "position", f"reference_{effect}")
                }
                yield _view(tensors, shard.samples[index], tensors[f"reference_{effect}"])
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise DataError(f"{path} can't be read: {error}") from error


def _view(tensors: Mapping[str, Any], record: Mapping[str, Any], reference: Any) -> View:
    position, normal = tensors["position"], tensors["normal"]
    whole = np.isfinite(position).all(0) & np.isfinite(normal).all(0)
    background = ~whole | (position[2] >= 0) | ~normal.any(0)
    position, normal = (np.where(background, np.float32(0), v) for v in (position, normal))
    known = record["camera"]
    (width, height), (x0, y0) = known["frame"], known["origin"]
    return View(
        scene=str(record["scene"]),
        normal=normal,
        position=position,
        background=background,
        radius=float(record["radius"]),
        fov=float(known["fov"]),
        reference=np.clip(reference[0], 0, 1),
        pixels_per_unit=Camera(known["fov"], width, height).pixels_per_unit,
        axis=(width / 2 - x0, height / 2 - y0),
        record=record,
    )
