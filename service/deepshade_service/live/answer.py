"""An answer of a live session, and its messages: each made once, however many want it."""

from __future__ import annotations

import asyncio
import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import live, pictures
from deepshade.effects import EFFECTS
from deepshade.floats import to_half
from deepshade_service.answers import Made

Float = NDArray[np.float32]

_QUALITY = 85  # of JPEG and WebP, for pictures that stay for 1/30 s


@dataclass(frozen=True, slots=True)
class Want:
    """How somebody wants answers: a codec, in 16 bits or 32, and the effect that is seen."""

    codec: str
    half: bool = True
    shows: str = ""
    rest: bool = False


@dataclass(slots=True)
class Answer:
    """One frame's answers, (C, H, W) an effect. `made_at` is the source's time by our clock.

    `full` is the size (width, height) of the source's picture, of which this may be a smaller one.
    """

    id: int
    shades: Mapping[str, Float]
    made: Sequence[Made]
    made_at: float
    full: tuple[int, int]
    took_ms: Mapping[str, float]
    rest: bool = False
    dropped: int = 0
    messages: dict[Want, asyncio.Task[bytes]] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        height, width = next(iter(self.shades.values())).shape[1:]
        return width, height

    async def message(self, want: Want) -> bytes:
        """The binary message, made in a thread by who asks first."""
        if want.codec not in live.PICTURES or want.shows not in self.shades:
            want = replace(want, shows=next(iter(self.shades)))  # of what holds all there is one
        if want not in self.messages:
            self.messages[want] = asyncio.create_task(asyncio.to_thread(self._encode, want))
        return await asyncio.shield(self.messages[want])

    def _encode(self, want: Want) -> bytes:
        now = time.time()
        flags = live.REST if want.rest or self.rest else 0
        about: dict[str, Any] = {
            "effects": list(self.shades),
            "shows": want.shows,
            "full": self.full,
            "dropped": self.dropped,
            "took_ms": {name: round(ms, 2) for name, ms in self.took_ms.items()},
        }
        if want.codec in live.PICTURES:
            content = picture(self.shades[want.shows], want.shows, want.codec)
            about["age_ms"] = self._age()
            return live.pack_picture(
                self.id,
                want.codec,
                content,
                self.size,
                about,
                time=self.made_at,
                sent=now,
                flags=flags,
            )
        planes: dict[str, NDArray[Any]] = {}
        for effect, shade in self.shades.items():
            for name, plane in zip(EFFECTS[effect].outputs, shade, strict=False):
                planes[f"{effect}.{name}"] = to_half(plane) if want.half else plane
        about["age_ms"] = self._age()
        packed = live.pack(
            live.ANSWER,
            self.id,
            planes,
            about,
            codec=want.codec,
            time=self.made_at,
            sent=now,
            flags=flags,
        )
        return bytes(packed)

    def _age(self) -> float:
        return round(1e3 * (time.time() - self.made_at), 1)


def picture(shade: Float, effect: str, codec: str) -> bytes:
    """A JPEG or WebP of an effect's answer (C, H, W), as `pictures.of_effect` shows it.

    Through a table of all 16-bit floats, because sRGB's power takes longer than the JPEG.
    """
    from PIL import Image

    pixels = _table(EFFECTS[effect].is_light)[to_half(shade).view(np.uint16)]
    shown = pixels[0] if len(pixels) == 1 else np.ascontiguousarray(pixels.transpose(1, 2, 0))
    stream = io.BytesIO()
    options = {"method": 0} if codec == "webp" else {}
    Image.fromarray(shown).save(stream, codec, quality=_QUALITY, **options)
    return stream.getvalue()


@cache
def _table(light: bool) -> NDArray[np.uint8]:
    halves = np.arange(2**16, dtype=np.uint16).view(np.float16).astype(np.float32)[None]
    curve = pictures.srgb if light else pictures.shading
    return np.ascontiguousarray(curve(np.nan_to_num(halves))[0, :, 0])
