"""What a request is answered with: one picture of one or several effects, and how it was made."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, pictures
from deepshade.effects import EFFECTS
from deepshade.exr.entries import Entry
from deepshade.gbuffer import GBuffer
from deepshade_service.composition import Composition
from deepshade_service.parameters import ShadeParameters
from deepshade_service.plan import Facts, Json

Float = NDArray[np.float32]

_STAGES = ("decode", "plan", "infer", "encode")


@dataclass(frozen=True, slots=True)
class Made:
    """How one effect was made: as facts and as a plan, of how many pixels, in what time.

    `view` is that of the files, where several were asked for.
    """

    effect: str
    facts: Facts
    plan: Json
    pixels: int
    computed: int
    milliseconds: Mapping[str, float]
    view: str = ""


@dataclass(frozen=True, slots=True)
class Shaded:
    """An encoded picture, or plans as JSON; how each effect was made, and what all share."""

    content: bytes
    media_type: str
    made: Sequence[Made]
    milliseconds: Mapping[str, float]

    @property
    def facts(self) -> Mapping[str, Any]:
        """Those of its effect, or of each, by its name; of several views those of the first."""
        first = _first_view(self.made)
        views: dict[str, Any] = {}
        if len(self.made) > len(first):
            warned = [
                f"{m.view}: {m.facts['warnings']}" for m in self.made if "warnings" in m.facts
            ]
            views["views"] = ",".join(dict.fromkeys(made.view for made in self.made))
            views |= {"warnings": "; ".join(warned)} if warned else {}
        if len(first) == 1:
            return first[0].facts | views
        names = ",".join(each.effect for each in first)
        return {"effects": names} | {each.effect: each.facts for each in first} | views

    @property
    def stages(self) -> dict[str, float]:
        """Milliseconds by stage, and what each of several effects took of it."""
        stages = {**dict.fromkeys(_STAGES, 0.0), **self.milliseconds}
        single: dict[str, float] = {}
        for each in self.made:
            for stage, ms in each.milliseconds.items():
                stages[stage] += ms
                name = f"{stage}-{each.effect}"
                single[name] = single.get(name, 0.0) + ms
        stages = {name: ms for name, ms in stages.items() if ms}
        return stages if len({each.effect for each in self.made}) == 1 else stages | single


@dataclass(frozen=True, slots=True)
class Place:
    """Where an answer lies: EXR attributes of the shot and the camera, and the windows."""

    attributes: Mapping[str, Any]
    data_window: exr.Window
    display_window: exr.Window

    @property
    def windows(self) -> tuple[exr.Window, exr.Window]:
        """Both windows."""
        return self.data_window, self.display_window

    @classmethod
    def of(cls, gbuffer: GBuffer) -> Place:
        """Where the G-buffer lies."""
        attributes = gbuffer.entries | gbuffer.placement()
        return cls(attributes, gbuffer.data_window, gbuffer.display_window)


def encode(
    shades: Sequence[Float],
    made: Sequence[Made],
    place: Place,
    asked: ShadeParameters,
    composition: Composition,
    own: Mapping[str, Float],
) -> tuple[bytes, str]:
    """The answer's bytes and media type; each of several effects is a layer of its name.

    Its header holds the facts and, as JSON, the plan of each; a PNG's the plan alone. `own` are the
    channels of the picture itself that go in; those of its beauty are multiplied in place.
    """
    for name, factor in zip(
        composition.beauty, np.broadcast_to(shades[0], (3, *shades[0].shape[1:])), strict=False
    ):
        np.multiply(own[name], factor, out=own[name], where=np.isfinite(own[name]))
    plan = json.dumps(plan_of(made), separators=(",", ":"))
    if asked.format == "png":
        if composition.beauty:
            picture = pictures.srgb(np.stack([own[name] for name in composition.beauty]))
        else:
            picture = pictures.of_effect(shades[0], EFFECTS[made[0].effect])
        return pictures.png(picture, {"deepshade:plan": plan}), "image/png"
    channels = dict(own)
    attributes = {**composition.attributes, **place.attributes}
    alone = f"{composition.layer}." if composition.layer else ""
    several = len(_first_view(made)) > 1
    for shade, each in zip(shades, made, strict=True):
        layer, key = (f"{each.effect}.", f"{each.effect}:") if several else (alone, "")
        if each.view != made[0].view:  # a view's name stands last (MultiViewOpenEXR)
            layer, key = f"{layer}{each.view}.", f"{key}{each.view}:"
        names = EFFECTS[each.effect].outputs if composition.shade else ()
        channels |= {f"{layer}{name}": plane for name, plane in zip(names, shade, strict=False)}
        attributes |= {f"deepshade:{key}{name}": value for name, value in each.facts.items()}
    if several:
        attributes["deepshade:effects"] = ",".join(each.effect for each in _first_view(made))
    if len(made) > len(_first_view(made)):
        attributes.pop("view", None)
        views = dict.fromkeys(each.view.encode() for each in made)
        packed = b"".join(struct.pack("<i", len(name)) + name for name in views)
        attributes["multiView"] = Entry("stringvector", packed)
    attributes["deepshade:plan"] = plan
    floats = {
        name for name in channels if not (composition.own[name].half if name in own else asked.half)
    }
    stream = io.BytesIO()
    exr.write(
        stream,
        channels,
        attributes=attributes,
        compression=asked.compression,
        half=channels.keys() - floats,
        data_window=place.data_window,
        display_window=place.display_window,
    )
    return stream.getvalue(), "image/x-exr"


def plan_of(made: Sequence[Made]) -> Json:
    """The plan of an effect, or of each by its name; of several views those of each."""
    views = dict.fromkeys(each.view for each in made)
    if len(views) > 1:
        return {view: plan_of([each for each in made if each.view == view]) for view in views}
    return made[0].plan if len(made) == 1 else {each.effect: each.plan for each in made}


def _first_view(made: Sequence[Made]) -> list[Made]:
    return [each for each in made if each.view == made[0].view]
