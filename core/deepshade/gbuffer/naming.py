"""What a file's name says: its shot, its attribute and its frame, as in `shot_normal.0007.exr`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

from deepshade.gbuffer.profiles import PROFILES, match_rank

_FRAME = re.compile(r"(.*?)[._\-\s]*(\d*)", re.DOTALL)
_SEPARATORS = "._-: /\t"
_ALIASES = {
    alias
    for profile in PROFILES.values()
    if not profile.free_names
    for source in profile.sources
    for alias in source.layers
}


@dataclass(frozen=True, slots=True)
class FileName:
    """`shot`, and as they are written `attribute` and `frame`; "" for what isn't there."""

    shot: str
    attribute: str = ""
    frame: str = ""


def parse_stem(stem: str) -> FileName:
    """What a file's name without its suffix says.

    The frame is the number at its end; what stands before that is an attribute where a file of
    one attribute is taken for it by its name (`match_rank`), and the rest is the shot.
    """
    match = _FRAME.fullmatch(stem)
    assert match is not None, "any text matches"
    return FileName(*_attribute(match[1]), match[2])


@lru_cache(maxsize=2**12)
def _attribute(text: str) -> tuple[str, str]:
    """(shot, attribute), of which the longest counts: "normal_world" rather than "world"."""
    for at in range(len(text)):
        if at and text[at - 1] not in _SEPARATORS:
            continue
        if any(match_rank(text[at:], alias, from_stem=True) in (0, 2) for alias in _ALIASES):
            return text[:at].rstrip(_SEPARATORS), text[at:]
    return text, ""
