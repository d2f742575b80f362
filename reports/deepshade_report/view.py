"""The held-out views that methods are compared on, at any size, and as EXR bodies."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, judging, metrics
from deepshade.attributes import ATTRIBUTES, RADIANCE
from deepshade.camera import Camera
from deepshade.effects import EFFECTS, SETTINGS, Effect
from deepshade.environments import Surroundings
from deepshade.environments.stored import surroundings_of
from deepshade.errors import DataError
from deepshade.files import sha256
from deepshade.gbuffer.background import remove
from deepshade.manifest import Manifest, shard_path

Float = NDArray[np.float32]
T = TypeVar("T", bound=np.generic)

WIDTH, HEIGHT = 768, 512  # the paper's frame
MEGAPIXELS = WIDTH * HEIGHT / 1e6
_MAX_HALF = 65504.0


@dataclass(frozen=True, eq=False)
class View:
    """One picture's attributes and the reference of one effect.

    `attributes` are (C, H, W) by name, camera space and scene units, zero where `background`
    (H, W) is true, but for those that say something there; the trivial answer's layer lies beside.
    `reference` is (C', H, W). `radius` is the effect's, in scene units. The `camera` may show more:
    the view is then a window of its frame. `record` is what the data set's manifest keeps to render
    the view again. `error` is the reference's standard error, where that is known; `surroundings`
    is the environment that it was rendered under.
    """

    scene: str
    effect: Effect
    attributes: Mapping[str, Float]
    background: NDArray[np.bool_]
    reference: Float
    radius: float
    camera: Camera
    record: Mapping[str, Any] = field(default_factory=dict)
    error: Float | None = None
    surroundings: Surroundings | None = None

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.background.shape[0])

    @property
    def width(self) -> int:
        """Columns."""
        return int(self.background.shape[1])

    def trivial(self) -> Float:
        """(C', H, W): the answer of doing nothing."""
        return judging.trivial(self.effect, self.attributes, self.reference, self.surroundings)

    def exposed(self, image: Float) -> Float:
        """(C', H, W) in [0, 1]: an answer exposed as the reference is."""
        return judging.exposed(self.effect, self.reference, np.asarray(image))[0]

    def dssim(self, image: Float) -> float:
        """DSSIM of an answer (C', H, W), exposed as the reference is."""
        return metrics.dssim(self.exposed(image), self.exposed(self.reference))

    def relative(self, image: Float) -> float:
        """SMAPE of an answer of light (C', H, W), exposed as the reference is, unclipped."""
        return judging.relative(self.reference, image)

    def light(self) -> Float | None:
        """(3, H, W) light that the effect starts from, None where it has none.

        Under an environment it is the trivial answer: what reaches surfaces that nothing blocks.
        """
        if "environment" in self.effect.settings:
            return self.trivial()
        names = [name for name in self.effect.inputs if ATTRIBUTES[name].unit is RADIANCE]
        return self.attributes[names[0]] if names else None

    @property
    def origin(self) -> str | None:
        """What `light` is, for a page."""
        if "environment" in self.effect.settings:
            return "doing nothing"
        return None if self.light() is None else "light"

    def floor(self) -> float | None:
        """What noise in the reference leaves (`judging.floor`); None where no error is known."""
        if self.error is None:
            return None
        return judging.floor(self.effect, self.reference, self.error)

    def contrast(self) -> float:
        """What the effect's row compares with `min_contrast`."""
        return judging.contrast(self.effect, self.reference, self.trivial())


def require(view: View) -> Surroundings:
    """The view's environment and its turn, or DataError."""
    if view.surroundings is None:
        raise DataError("the views are lit by no environment", fix="render them again")
    return view.surroundings


def load_views(folder: Path, effect: str, limit: int | None = None) -> list[View]:
    """The views of a data set that have something of the effect to show, at most `limit`.

    Raises DataError: `folder` holds no such data set, a shard is damaged, or no view shows enough.
    """
    row, manifest = EFFECTS[effect], Manifest.read(folder)
    own = {f"reference_{effect}", *([row.trivial_layer] if row.trivial_layer else [])}
    if missing := {*row.inputs, *own} - set(manifest.schema):
        raise DataError(
            f"{folder} has no {', '.join(sorted(missing))}",
            fix=f"render it with --effects {effect}",
        )
    own.add(f"reference_{effect}_error")
    names = [name for name in manifest.schema if name in ATTRIBUTES or name in own]
    found: list[View] = []
    for shard in manifest.shards:
        path = shard_path(folder, shard)
        if not path.is_file() or sha256(path) != shard.sha256:
            raise DataError(
                f"{path} is not the file that the manifest describes",
                fix="run the same 'deepshade datagen' again: it renders what is missing or damaged",
            )
        for view in _read(path, shard.samples, row, names):
            if view.contrast() >= row.min_contrast:
                found.append(view)
            if len(found) == limit:
                return found
    if not found:
        raise judging.nothing_shown(row, str(folder), row.min_contrast)
    return found


def _read(
    path: Path, records: Sequence[Mapping[str, Any]], effect: Effect, names: Sequence[str]
) -> Iterator[View]:
    from safetensors import safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            stored = {name: file.get_slice(name) for name in names}
            for index, record in enumerate(records):
                planes = {name: plane[index].astype(np.float32) for name, plane in stored.items()}
                reference = planes.pop(f"reference_{effect.name}")
                error = planes.pop(f"reference_{effect.name}_error", None)
                beside = {name: planes.pop(name) for name in planes.keys() - ATTRIBUTES.keys()}
                background, _ = remove(planes, list(planes))
                planes |= beside
                known = record["camera"]
                frame = known["fov"], *known["frame"], known["world_to_camera"], *known["origin"]
                radius = float(record.get("radius") or 1.0)
                scene, camera = str(record["scene"]), Camera(*frame)
                made = effect, planes, background, reference, radius, camera, record, error
                yield View(scene, *made, surroundings_of(path.parent, record))
    except (OSError, ValueError, KeyError, IndexError, TypeError) as problem:
        raise DataError(f"{path} can't be read: {problem!r}") from problem


def fullest(views: Sequence[View]) -> View:
    """The view with the least background: what can be skipped shall not flatter a timing."""
    return min(views, key=lambda view: float(view.background.mean()))


def resized(view: View, height: int = HEIGHT, width: int = WIDTH) -> View:
    """The view cut, or continued by mirroring, to `height` x `width`.

    Mirrored positions are no real geometry, but smooth, and in the values that a timing needs.
    """
    planes = {name: _fit(plane, height, width) for name, plane in view.attributes.items()}
    empty, answer = _fit(view.background, height, width), _fit(view.reference, height, width)
    return replace(view, attributes=planes, background=empty, reference=answer, error=None)


def body(view: View, height: int = HEIGHT, width: int = WIDTH, *, grain: bool = False) -> bytes:
    """The view as a renderer would send it at a size: an EXR of the effect's inputs, half ZIP.

    What repeats compresses far better than any real picture. With `grain` the two lowest bits of
    each half float are random, which is less than a thousandth of its value. Planes are made one
    by one, which spares memory at 8192 x 8192.
    """
    noise = np.random.default_rng(0).integers(0, 4, 2**20 + 7, dtype=np.uint16)
    channels: dict[str, NDArray[np.float16]] = {}
    for name in view.effect.inputs:
        exact = view.attributes[name]
        clipped = np.clip(exact, -_MAX_HALF, _MAX_HALF)
        # what is infinitely far stays so: it is background
        planes = np.where(np.isinf(exact), exact, clipped).astype(np.float16)
        for channel, plane in zip(ATTRIBUTES[name].channels, planes, strict=True):
            channels[channel] = half = _fit(plane, height, width)
            if grain:
                bits = half.view(np.uint16)
                some = np.resize(noise, bits.shape)
                np.bitwise_xor(bits, some, out=bits, where=(bits & 0x7FFF) > 4)
    # the angle that keeps the view's pixels per unit
    fov = math.degrees(2 * math.atan(width / 2 / view.camera.pixels_per_unit))
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
