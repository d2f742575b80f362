"""Frames as live sessions send them (docs/streaming.md): packed, parsed, compressed."""

from deepshade.live.codecs import CODECS, PICTURES, available
from deepshade.live.frames import (
    ANSWER,
    CUT,
    GBUFFER,
    REST,
    Frame,
    FrameError,
    pack,
    pack_picture,
    parse,
    stamp,
)

__all__ = [
    "ANSWER",
    "CODECS",
    "CUT",
    "GBUFFER",
    "PICTURES",
    "REST",
    "Frame",
    "FrameError",
    "available",
    "pack",
    "pack_picture",
    "parse",
    "stamp",
]
