"""What goes into a stream and what comes out: a picture's planes, and an answer's."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, live
from deepshade.attributes import ATTRIBUTES, PIXELS, SCREEN_MOTION
from deepshade.floats import to_half
from deepshade.gbuffer.naming import parse_stem
from deepshade.gbuffer.plan import chosen, plan_gbuffer
from deepshade_client.exceptions import ServerProblem

Plane = NDArray[Any]

_IN_PIXELS = [a for a in ATTRIBUTES.values() if a.unit in (PIXELS, SCREEN_MOTION)]
_NO_HEADER = ("lineOrder", "channels", "chunkCount")


@dataclass(frozen=True, slots=True)
class Picture:
    """A G-buffer: planes (H, W), float16 or float32, by the names that an EXR's channels have.

    `header` is what that EXR's header would say (`deepshade:fov`, `worldToCamera`, …), `name` what
    its answer is called. `settings` and `effects` are those of this picture alone, `cut` says that
    it has nothing to do with the one before. Planes `in_pixels` hold lengths on the screen.
    """

    planes: Mapping[str, Plane]
    header: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    number: int | None = None
    settings: Mapping[str, Any] | None = None
    effects: str | None = None
    cut: bool = False
    made: float | None = None
    in_pixels: frozenset[str] = frozenset(name for a in _IN_PIXELS for name in a.channels)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = next(iter(self.planes.values())).shape
        return width, height

    def smaller(self, step: int) -> Picture:
        """Every `step`-th pixel each way, from the middle of its block on."""
        if step == 1:
            return self
        height, width = next(iter(self.planes.values())).shape
        rows, columns = (min(step // 2, (side - 1) // 2) for side in (height, width))
        planes = {}
        for name, plane in self.planes.items():
            few = plane[rows::step, columns::step]
            by = step if name in self.in_pixels else 1
            planes[name] = np.ascontiguousarray(few if by == 1 else few / plane.dtype.type(by))
        return replace(self, planes=planes)

    def about(self) -> dict[str, Any]:
        """The JSON of its frame, without its planes."""
        about: dict[str, Any] = {"header": {k: _plain(v) for k, v in self.header.items()}}
        if self.settings is not None:
            about["settings"] = self.settings
        if self.effects is not None:
            about["effects"] = self.effects
        return about


@dataclass(frozen=True, slots=True)
class LiveAnswer:
    """What came back for a picture.

    `planes` are "ao.Y", "gi.R" and so on, as they were sent; `age` seconds since the source made
    the picture, `took_ms` the service's stages, `dropped` how many of the session's pictures were
    overwritten so far. `sharp` is that of a picture that rests. `error` says why there is none.
    """

    id: int
    picture: Picture
    planes: Mapping[str, Plane]
    age: float
    took_ms: Mapping[str, float] = field(default_factory=dict)
    dropped: int = 0
    sharp: bool = False
    received_bytes: int = 0
    sent_bytes: int = 0
    error: ServerProblem | None = None
    plans: Mapping[str, Any] = field(default_factory=dict)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """By effect, (1, H, W) or (3, H, W). Raises what `error` holds."""
        if self.error is not None:
            raise self.error
        layers: dict[str, list[Plane]] = {}
        for name, plane in self.planes.items():
            layers.setdefault(name.partition(".")[0], []).append(plane)
        return {effect: np.stack(planes).astype(np.float32) for effect, planes in layers.items()}


def read_picture(
    files: Sequence[Path],
    needs: Collection[str] | None = None,
    *,
    mapping: Mapping[str, str] | None = None,
    profile: str | None = None,
    name: str = "",
    number: int | None = None,
) -> Picture:
    """The picture in one EXR, or in several of one view, with the channels that `needs` come from.

    Without `needs`, or where they can't be found in the header, all channels: the service says
    what is missing. What is stored in 16 bits stays so. Raises ImageError.
    """
    headers = [exr.read_header(file) for file in files]
    wanted: list[dict[str, None]] = [dict.fromkeys(header.channels()) for header in headers]
    measured: set[tuple[int, str]] = set()
    if needs:
        stems = [file.stem for file in files]
        plan = plan_gbuffer(headers, stems, list(needs), mapping=mapping, profile=profile)
        if all(plan.steps(need) is not None for need in needs):
            used = {*needs}
            for need in needs:
                used |= {source for step in plan.steps(need) or () for source in step.needs}
            wanted = [{} for _ in files]
            for quantity, choice in chosen(plan, used, mapping or {}).items():
                wanted[choice.file] |= dict.fromkeys(choice.channels)
                if quantity in {a.name for a in _IN_PIXELS}:
                    measured |= {(choice.file, channel) for channel in choice.channels}
    planes: dict[str, Plane] = {}
    in_pixels = set()
    for index, (file, header) in enumerate(zip(files, headers, strict=True)):
        places = header.channels()
        parts = {channel: header.parts[places[channel][0]] for channel in wanted[index]}
        flat = [name for name in parts if places[name][1] not in parts[name].subsampled]
        image = exr.read(file, flat, header=header)
        layer = parse_stem(file.stem).attribute if len(files) > 1 else ""
        for channel in flat:
            half = parts[channel].channels[places[channel][1]] == "half"
            label = channel.replace(":", ".")
            if layer and "." not in label:
                label = f"{layer}.{label}"
            plane = image.pixels[channel]
            planes[label] = to_half(plane) if half else plane
            if (index, channel) in measured:
                in_pixels.add(label)
    said: dict[str, Any] = {}
    for part in (part for header in headers for part in header.parts):
        for key, value in part.attributes.items():
            if key not in _NO_HEADER and _sendable(value):
                said.setdefault(key, value)
    found = Picture(planes, said, name, number)
    return replace(found, in_pixels=found.in_pixels | in_pixels)


def of_frame(frame: live.Frame, name: str = "", number: int | None = None) -> Picture:
    """The picture that a renderer sent as a frame. Raises DamagedImageError."""
    about = frame.about
    return Picture(
        frame.planes(),
        dict(about.get("header", {})),
        name,
        number,
        settings=about.get("settings"),
        effects=about.get("effects"),
        cut=bool(frame.flags & live.CUT),
        made=frame.time,
    )


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | tuple | list):
        return np.asarray(value).ravel().tolist()
    return value


def _sendable(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= 1000
    if isinstance(value, int | float):
        return bool(np.isfinite(value))
    array = np.asarray(value)
    known = array.size in (2, 3, 9, 16) and array.dtype.kind in "fiu"
    return known and bool(np.isfinite(array).all())
