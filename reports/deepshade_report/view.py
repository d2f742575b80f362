"""The held-out views that methods are compared on, at any size, and as EXR bodies."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, metrics
from deepshade.attributes import ATTRIBUTES
from deepshade.camera import Camera
from deepshade.effects import EFFECTS, SETTINGS, Effect
from deepshade.errors import DataError
from deepshade.files import sha256
from deepshade.gbuffer import background
from deepshade.manifest import Manifest, shard_path

Float = NDArray[np.float32]
T = TypeVar("T", bound=np.generic)

WIDTH, HEIGHT = 768, 512  # the paper's frame
MEGAPIXELS = WIDTH * HEIGHT / 1e6
_MAX_HALF = 65504.0


@dataclass(frozen=True)
class View:
    """One picture's attributes and the reference of one effect.

    `attributes` are (C, H, W) by name, camera space and scene units, zero where `background`
    (H, W) is true, but for those that say something there. `reference` is (C', H, W). `radius` is
    the effect's, in scene units; `fov` the full horizontal angle of the frame that the view shows
    or is a window of, in degrees. `pixels_per_unit` are the pixels that a length of 1 spans at
    distance 1, and `axis` is the pixel (column, row) that the optical axis meets: None means that
    the view is the frame. `record` is what the data set's manifest keeps to render it again.
    """

    scene: str
    effect: Effect
    attributes: Mapping[str, Float]
    background: NDArray[np.bool_]
    reference: Float
    radius: float
    fov: float
    pixels_per_unit: float | None = None
    axis: tuple[float, float] | None = None
    record: Mapping[str, Any] = field(default_factory=dict)

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.background.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.background.shape[1])

    def pixel_scale(self) -> float:
        """Pixels that a horizontal length of 1 at distance 1 spans."""
        if self.pixels_per_unit is not None:
            return self.pixels_per_unit
        return Camera(self.fov, self.width, self.height).pixels_per_unit

    def optical_axis(self) -> tuple[float, float]:
        """Column and row, in pixels from the top left corner, where the optical axis lies."""
        return (self.width / 2, self.height / 2) if self.axis is None else self.axis

    def camera(self) -> Camera:
        """The camera that the view was rendered with, with its place in the world.

        Raises DataError when the view's record holds none.
        """
        try:
            known = self.record["camera"]
            (width, height), (x0, y0) = known["frame"], known["origin"]
            return Camera(known["fov"], width, height, known["world_to_camera"], x0, y0)
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"the view of {self.scene} has no camera: {error}",
                fix="use a data set that 'deepshade datagen' wrote",
            ) from error

    def trivial(self) -> Float:
        """(C', H, W): the answer of doing nothing."""
        known = self.effect.trivial
        answer = self.attributes[known] if isinstance(known, str) else np.float32(known)
        return np.ascontiguousarray(np.broadcast_to(answer, self.reference.shape))

    def exposed(self, image: Float) -> Float:
        """(C', H, W) in [0, 1]: light times the factor that exposes the reference, clipped."""
        factor = metrics.exposure(self.reference) if self.effect.is_light else 1.0
        shown: Float = np.clip(np.asarray(image, np.float32) * np.float32(factor), 0, 1)
        return shown

    def dssim(self, image: Float) -> float:
        """DSSIM of an answer (C', H, W), exposed as the reference is."""
        return metrics.dssim(self.exposed(image), self.exposed(self.reference))

    def contrast(self) -> float:
        """What the effect's row compares with `min_contrast`."""
        if self.effect.contrast == "deviation":
            return float(self.exposed(self.reference).std())
        return self.dssim(self.trivial())


def load_views(folder: Path, effect: str, limit: int | None = None) -> list[View]:
    """The views of a data set that have something of the effect to show, at most `limit`.

    Raises DataError: `folder` holds no such data set, a shard is damaged, or no view shows enough.
    """
    row, manifest = EFFECTS[effect], Manifest.read(folder)
    reference = f"reference_{effect}"
    if missing := {*row.inputs, reference} - set(manifest.schema):
        raise DataError(
            f"{folder} has no {', '.join(sorted(missing))}",
            fix=f"render it with --effects {effect}",
        )
    names = [name for name in manifest.schema if name in ATTRIBUTES] + [reference]
    found: list[View] = []
    for shard in manifest.shards:
        path = shard_path(folder, shard)
        if not path.is_file():
            raise DataError(f"{path} is named by the manifest but missing")
        if sha256(path) != shard.sha256:
            raise DataError(
                f"{path} is not the file that the manifest describes",
                fix="run the same 'deepshade datagen' again: it renders what is damaged",
            )
        for record, planes in zip(shard.samples, _samples(path, names), strict=False):
            view = _view(row, record, planes, planes.pop(reference))
            if view.contrast() >= row.min_contrast:
                found.append(view)
            if len(found) == limit:
                return found
    if not found:
        raise DataError(
            f"no view of {folder} has a contrast of {row.min_contrast}",
            fix="render views that show more: deepshade datagen --min-contrast",
        )
    return found


def _samples(path: Path, names: Sequence[str]) -> Any:
    from safetensors import safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            planes = {name: file.get_slice(name) for name in names}
            for index in range(planes[names[0]].get_shape()[0]):
                yield {name: plane[index].astype(np.float32) for name, plane in planes.items()}
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise DataError(f"{path} can't be read: {error}") from error


def _view(row: Effect, record: Mapping[str, Any], planes: dict[str, Float], answer: Float) -> View:
    empty, _ = background.remove(planes, list(planes))
    known = record["camera"]
    (width, height), (x0, y0) = known["frame"], known["origin"]
    return View(
        scene=str(record["scene"]),
        effect=row,
        attributes=planes,
        background=empty,
        reference=answer,
        radius=float(record.get("radius") or 1.0),
        fov=float(known["fov"]),
        pixels_per_unit=Camera(known["fov"], width, height).pixels_per_unit,
        axis=(width / 2 - x0, height / 2 - y0),
        record=record,
    )


def fullest(views: Sequence[View]) -> View:
    """The view with the least background: what can be skipped shall not flatter a timing."""
    return min(views, key=lambda view: float(view.background.mean()))


def resized(view: View, height: int = HEIGHT, width: int = WIDTH) -> View:
    """The view cut, or continued by mirroring, to `height` x `width`.

    Mirrored positions are no real geometry, but smooth, and in the values that a timing needs.
    """
    planes = {name: _fit(plane, height, width) for name, plane in view.attributes.items()}
    empty, answer = _fit(view.background, height, width), _fit(view.reference, height, width)
    return replace(view, attributes=planes, background=empty, reference=answer)


def body(view: View, height: int = HEIGHT, width: int = WIDTH, *, grain: bool = False) -> bytes:
    """The view as a renderer would send it at a size: an EXR of the effect's inputs, half ZIP.

    What repeats compresses far better than any real picture. With `grain` the two lowest bits of
    each half float are random, which is less than a thousandth of its value. Planes are made one
    by one, which spares memory at 8192 x 8192.
    """
    noise = np.random.default_rng(0).integers(0, 4, 2**20 + 7, dtype=np.uint16)
    channels: dict[str, NDArray[np.float16]] = {}
    for name in view.effect.inputs:
        planes = np.clip(view.attributes[name], -_MAX_HALF, _MAX_HALF).astype(np.float16)
        for channel, plane in zip(ATTRIBUTES[name].channels, planes, strict=True):
            channels[channel] = half = _fit(plane, height, width)
            if grain:
                bits = half.view(np.uint16)
                some = np.resize(noise, bits.shape)
                np.bitwise_xor(bits, some, out=bits, where=(bits & 0x7FFF) > 4)
    # the angle that keeps the view's pixels per unit
    fov = math.degrees(2 * math.atan(width / 2 / view.pixel_scale()))
    settings = {SETTINGS[name].header: view.record.get(name) for name in view.effect.settings}
    known = {name: value for name, value in settings.items() if value is not None}
    known |= {SETTINGS["radius"].header: view.radius, "deepshade:fov": fov}
    with io.BytesIO() as stream:
        exr.write(stream, channels, half=True, attributes=known)
        return stream.getvalue()


def _fit(image: NDArray[T], height: int, width: int) -> NDArray[T]:
    rows, columns = image.shape[-2:]
    pad = [(0, 0)] * (image.ndim - 2)
    pad += [(0, max(0, height - rows)), (0, max(0, width - columns))]
    return np.ascontiguousarray(np.pad(image, pad, "symmetric")[..., :height, :width])
