"""Answers for the comp: beside the picture's own channels, or multiplied onto its beauty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr
from deepshade.effects import Effect
from deepshade.errors import AmbiguousChannelError, MissingAttributeError
from deepshade.gbuffer import GBuffer, channels
from deepshade.gbuffer.naming import parse_stem
from deepshade.gbuffer.profiles import detect, profile
from deepshade_service.memory import size_of
from deepshade_service.parameters import ShadeParameters
from deepshade_service.plan import Facts
from deepshade_service.problems import Problem
from deepshade_service.uploads import Upload

Float = NDArray[np.float32]

_NOT_KEPT = ("lineOrder", "envmap", "channels", "chunkCount")


@dataclass(frozen=True, slots=True)
class Own:
    """A channel of the picture that goes into the answer: its file, its name there, its type."""

    file: int
    channel: str
    half: bool


@dataclass(frozen=True, slots=True)
class Composition:
    """What an answer holds beside what was shaded.

    `layer` is the answer's ("" for none); `own` are the picture's channels by their names in the
    answer, of which those in `beauty` are multiplied by it; `shade` says whether the answer's own
    channels are there too. `attributes` are kept of the picture's header.
    """

    layer: str = ""
    own: Mapping[str, Own] = field(default_factory=dict)
    beauty: tuple[str, ...] = ()
    shade: bool = True
    attributes: Mapping[str, Any] = field(default_factory=dict)
    facts: Facts = field(default_factory=dict)

    def read(self, files: Sequence[Upload], headers: Sequence[exr.Header]) -> dict[str, Float]:
        """The picture's channels, (H, W) float32, by their names in the answer."""
        planes: dict[str, Float] = {}
        for index, header in enumerate(headers):
            mine = {name: own.channel for name, own in self.own.items() if own.file == index}
            if mine:
                pixels = exr.read(files[index].data, list(mine.values()), header=header).pixels
                planes |= {name: pixels[channel] for name, channel in mine.items()}
        return planes


def check(asked: ShadeParameters, effects: Sequence[Effect]) -> None:
    """Raises Problem 422 for what can't be asked for together, whatever the picture."""
    effect = effects[0]
    if asked.format == "png" and (asked.append or asked.layer):
        name = "append" if asked.append else "layer"
        raise _wrong(f"?{name}= is for an EXR, a PNG has no layers", f"leave out ?{name}=")
    if len(effects) > 1 and (asked.layer or asked.multiply):
        name = "layer" if asked.layer else "multiply"
        raise _wrong(
            f"?{name}= is for one effect, and several were asked for",
            f"leave out ?{name}=; several effects are layers of their own names",
        )
    if asked.multiply and effect.is_light:
        raise _wrong(
            f"'{effect.name}' is light, which isn't multiplied onto a picture",
            "leave out ?multiply=; docs/compositing.md says how layers go together",
        )


def bytes_of(headers: Sequence[exr.Header], asked: ShadeParameters) -> int:
    """What the picture's own channels take in memory, beside what shading takes."""
    count = 4 if asked.multiply else 0
    if asked.append:
        count = sum(len(part.channels) for header in headers for part in header.parts)
    return 4 * count * prod(size_of(headers))


def compose(
    files: Sequence[Upload],
    headers: Sequence[exr.Header],
    asked: ShadeParameters,
    effects: Sequence[Effect],
    gbuffer: GBuffer,
) -> Composition:
    """What the answer to a picture holds, by its headers and where `gbuffer` lies.

    Raises MissingAttributeError and AmbiguousChannelError for the beauty, Problem 422 where that
    covers other pixels or the layer's name is taken.
    """
    layer = asked.layer or (effects[0].name if asked.append and len(effects) == 1 else "")
    own: dict[str, Own] = {}
    left: list[str] = []
    if asked.append:
        own, left = _all(files, headers, gbuffer.data_window)
    beauty: tuple[str, ...] = ()
    if asked.multiply:
        beauty, own = _with_beauty(own, files, headers, asked, gbuffer.data_window)
        if not asked.append and layer:
            beauty = tuple(f"{layer}.{name}" for name in beauty)
            own = {f"{layer}.{name}": channel for name, channel in own.items()}
    facts: Facts = {"layer": layer} if layer else {}
    if asked.append:
        facts["appended"] = len(own)
        _check_free(own, [layer] if layer else [effect.name for effect in effects])
    if left:
        facts["left_out"] = ", ".join(left)
    if beauty:
        facts["multiplied"] = ", ".join(own[name].channel for name in beauty)
    kept = _kept(gbuffer.header) if own else {}
    return Composition(layer, own, beauty, asked.append or not beauty, kept, facts)


def _all(
    files: Sequence[Upload], headers: Sequence[exr.Header], window: exr.Window
) -> tuple[dict[str, Own], list[str]]:
    """(all channels by their names in the answer, those that it can't hold)."""
    own: dict[str, Own] = {}
    left: list[str] = []
    for index, (file, header) in enumerate(zip(files, headers, strict=True)):
        word = _stem(file) if len(files) > 1 else ""
        named = _is_named_by(file, header)
        for qualified, (at, bare) in header.channels().items():
            part = header.parts[at]
            if (
                part.data_window != window
                or bare in part.subsampled
                or part.channels[bare] == "uint"
            ):
                left.append(qualified)
                continue
            label = word or part.name or str(at)
            names = [f"{word}.{bare}"] if named and word else [bare, f"{label}.{bare}"]
            free = [name for name in names if name not in own]
            if free:
                own[free[0]] = Own(index, qualified, part.channels[bare] == "half")
            else:
                left.append(qualified)
    return own, left


def _is_named_by(file: Upload, header: exr.Header) -> bool:
    """Whether the file's name is its only layer's, and says an attribute other than beauty."""
    (only, *more) = [a for a in channels.layers([header], [_stem(file)]) if a.name != "A"]
    attribute = parse_stem(_stem(file)).attribute
    return not more and only.from_stem and bool(attribute) and attribute.lower() != "beauty"


def _stem(file: Upload) -> str:
    stem = file.name.rpartition(".")[0] or file.name
    return parse_stem(stem).attribute or stem


def _with_beauty(
    own: Mapping[str, Own],
    files: Sequence[Upload],
    headers: Sequence[exr.Header],
    asked: ShadeParameters,
    window: exr.Window,
) -> tuple[tuple[str, ...], dict[str, Own]]:
    """(names of the beauty's three channels in the answer, `own` with them and its alpha)."""
    choice = _find_beauty(files, headers, asked)
    places = headers[choice.file].channels()
    part = headers[choice.file].parts[places[choice.channels[0]][0]]
    if part.data_window != window:
        raise _wrong(
            f"the beauty ({', '.join(choice.channels)}) covers other pixels than the G-buffer",
            "render both in one data window (without cropping to what is there)",
        )
    there = {(each.file, each.channel): name for name, each in own.items()}
    if not there:
        stem = choice.channels[0][:-1] if choice.channels[0][-1] in "Rr" else ""
        alpha = next((c for c in places if c == f"{stem}A"), None)
        wanted = dict(zip("RGB", choice.channels, strict=True)) | ({"A": alpha} if alpha else {})
        own = {
            name: Own(choice.file, channel, part.channels[places[channel][1]] == "half")
            for name, channel in wanted.items()
        }
        return ("R", "G", "B"), own
    return tuple(there[choice.file, channel] for channel in choice.channels), dict(own)


def _find_beauty(
    files: Sequence[Upload], headers: Sequence[exr.Header], asked: ShadeParameters
) -> channels.Choice:
    facts = {k: v for h in headers for part in h.parts for k, v in part.attributes.items()}
    known = profile(asked.profile) if asked.profile else detect(facts)
    layers = channels.layers(headers, [file.name.rpartition(".")[0] for file in files])
    found, ambiguous = channels.choose(layers, ["beauty"], known, asked.mapping)
    if "beauty" in ambiguous:
        raise ambiguous["beauty"]
    if "beauty" in found:
        return found["beauty"]
    taken = {(choice.file, name) for choice in found.values() for name in choice.channels}
    rest = list(_plain(layers, taken))
    if len(rest) > 1:
        raise AmbiguousChannelError("beauty", [", ".join(choice.channels) for choice in rest])
    if not rest:
        raise MissingAttributeError(["beauty"], [c for layer in layers for c in layer.channels])
    return rest[0]


def _plain(
    layers: Sequence[channels.Layer], taken: set[tuple[int, str]]
) -> Iterator[channels.Choice]:
    """R, G and B without a layer's name, in files whose names say no attribute."""
    for layer in layers:
        if layer.name and not (layer.from_stem and not parse_stem(layer.name).attribute):
            continue
        picked = layer.pick("beauty", "rgb")
        if picked and not any((layer.file, name) in taken for name in picked):
            yield channels.Choice("beauty", layer.file, picked)


def _check_free(own: Mapping[str, Own], layers: Sequence[str]) -> None:
    for layer in layers:
        if any(name.startswith(f"{layer}.") for name in own):
            raise _wrong(
                f"the picture has a layer '{layer}' already",
                f"name the answer's: ?layer={layer}2" if len(layers) == 1 else "leave out ?append=",
            )


def _kept(header: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes that an EXR of ours can hold."""
    return {
        name: value
        for name, value in header.items()
        if name not in _NOT_KEPT
        and (
            isinstance(value, int | float | str)
            or (isinstance(value, tuple | np.ndarray) and np.shape(value) in _SHAPES)
        )
    }


_SHAPES = ((2,), (3,), (3, 3), (4, 4))


def _wrong(detail: str, fix: str) -> Problem:
    return Problem(422, "bad-parameter", detail, fix=fix)
