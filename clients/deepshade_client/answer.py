"""Shaded pictures as the service sends them, in memory or saved."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, pictures
from deepshade.errors import ImageError
from deepshade.files import replacing
from deepshade_client.exceptions import BadAnswer

_PREFIX = "deepshade-"
PNG = b"\x89PNG"  # how such a file begins


@dataclass(frozen=True, slots=True, repr=False)
class Answer:
    """A shaded picture as it was received.

    `content` is the file (`media_type` says EXR or PNG), `facts` what the service says about it
    (bundle, radius, radius_source, derived, background_pixels, …; of several effects
    "ao.bundle" and so on), and `timing` the service's milliseconds for each of its stages.
    """

    content: bytes
    media_type: str
    facts: Mapping[str, str]
    timing: Mapping[str, float]

    def __repr__(self) -> str:
        """What it is, without its bytes."""
        known = [f"{k} {self.facts[k]}" for k in ("bundle", "radius") if k in self.facts]
        size = f"{self.media_type}, {len(self.content):,} bytes"
        return f"<Answer {', '.join((','.join(self.effects), size, *known))}>"

    @property
    def effects(self) -> list[str]:
        """The effects that it holds, in the order asked for."""
        return self.facts.get("effects", self.facts.get("effect", "")).split(",")

    def save(self, path: Path | str) -> Path:
        """Write the file; whatever was there is replaced only when all is written."""
        target = Path(path)
        with replacing(target) as temporary:
            temporary.write_bytes(self.content)
        return target

    def plan(self) -> dict[str, Any]:
        """How it was made, and why, as the file's header says; {} if it doesn't.

        The same as `Client.explain` gives: for several effects a plan for each. Raises
        BadAnswer when the file is damaged.
        """
        try:
            return plan_in(self.content)
        except (ImageError, ValueError) as error:
            raise BadAnswer(f"the answer's header can't be read: {error}") from error

    def channels(self) -> dict[str, NDArray[np.float32]]:
        """The decoded EXR: (H, W) float32 under "Y", or "R", "G" and "B".

        Of several effects each is a layer: "ao.Y", "gi.R" and so on; so is an answer beside the
        picture's own channels. Raises BadAnswer when it is a PNG or can't be decoded.
        """
        try:
            return exr.read(self.content).pixels
        except ImageError as error:
            raise BadAnswer(f"the answer ({self.media_type}) can't be decoded: {error}") from error

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The decoded EXR by effect: (1, H, W) or (3, H, W) float32.

        Raises what `channels` raises, and BadAnswer where an effect has no channel.
        """
        channels, effects = self.channels(), self.effects
        found = {}
        for effect in effects:
            layer = f"{effect}." if len(effects) > 1 else self.facts.get("layer", "")
            layer += "." if layer and not layer.endswith(".") else ""
            names = [name for name in (f"{layer}{band}" for band in "YRGB") if name in channels]
            if not names:
                raise BadAnswer(f"the answer holds no '{effect}', only {', '.join(channels)}")
            found[effect] = np.stack([channels[name] for name in names])
        return found


@dataclass(frozen=True, slots=True)
class Saved:
    """A shaded picture that went to disk as it arrived: where it is, and what is known of it.

    `media_type`, `facts` and `timing` are as in `Answer`.
    """

    path: Path
    media_type: str
    facts: Mapping[str, str]
    timing: Mapping[str, float]


def plan_in(content: bytes) -> dict[str, Any]:
    """The plan in an answer's bytes, EXR or PNG; {} where there is none.

    Raises ImageError or ValueError for a damaged file.
    """
    entries: Mapping[str, Any]
    if content.startswith(PNG):
        entries = pictures.texts_of(content)
    else:
        entries = exr.read_header(content).parts[0].attributes
    plan = json.loads(entries.get("deepshade:plan", "{}"))
    return plan if isinstance(plan, dict) else {}


def facts(headers: Mapping[str, str]) -> dict[str, str]:
    """The Deepshade-* headers, as in "radius_source"; of several effects as in "ao.radius".

    Raises BadAnswer when those of an effect can't be read.
    """
    found = {
        name[len(_PREFIX) :].lower().replace("-", "_"): value
        for name, value in headers.items()
        if name.lower().startswith(_PREFIX)
    }
    for effect in filter(None, found.get("effects", "").split(",")):
        try:
            each = json.loads(found.pop(effect))
            found |= {f"{effect}.{name}": str(value) for name, value in each.items()}
        except (KeyError, ValueError, AttributeError) as error:
            raise BadAnswer(f"the answer's header about '{effect}' can't be read") from error
    return found


def timing(value: str) -> dict[str, float]:
    """Milliseconds by stage from a Server-Timing header."""
    return {name: float(ms) for name, ms in re.findall(r"([\w-]+);dur=(\d+(?:\.\d+)?)", value)}
