"""Which frames of a stream are checked against themselves: not all, where that changes nothing.

The checks of a G-buffer take longer than all else that is done to it. What they find is how its
renderer stores values, and that stays. So a stream whose first frame comes out the same without
them does without for a second, and then they look again; each time that nothing has changed they
wait twice as long, at most a minute. Places in 16 bits are another matter: how coarse they are, and
so whether they are repaired, differs from frame to frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from deepshade.gbuffer import GBuffer
from deepshade_service.parameters import ShadeParameters

_AGAIN, _LONGEST = 1.0, 60.0  # seconds
_PLACES = ("position", "position_world", "depth", "distance")


class Trust:
    """Remembers what the checks changed, of frames with the same planes and settings."""

    def __init__(self) -> None:
        self._key: object = None
        self._until = 0.0
        self._wait = _AGAIN

    def load(
        self,
        key: tuple[Sequence[Sequence[str]], object],
        asked: ShadeParameters,
        load: Callable[[ShadeParameters], list[GBuffer]],
    ) -> list[GBuffer]:
        """What `load` gives with these settings, as far as it can be known without the checks.

        `key` begins with the frame's planes, each [name, "half" or "float"]. Raises what `load`
        raises.
        """
        if asked.strict or asked.trust:
            return load(asked)
        trusting = asked.model_copy(update={"trust": True})
        if key == self._key and time.monotonic() < self._until:
            return load(trusting)
        looked = key == self._key and self._until == 0  # they changed something: always check
        found = load(asked)
        if not looked:
            same = not _coarse(found, key[0]) and _same(found, load(trusting))
            self._wait = min(2 * self._wait, _LONGEST) if key == self._key else _AGAIN
            self._key = key
            self._until = time.monotonic() + self._wait if same else 0.0
        return found


def _coarse(found: Sequence[GBuffer], planes: Sequence[Sequence[str]]) -> bool:
    """Whether places come from planes of 16 bits."""
    halves = {name for name, kind in planes if kind == "half"}
    texts = (text for each in found for name, text in each.mapped.items() if name in _PLACES)
    return any(name in text for text in texts for name in halves)


def _same(some: Sequence[GBuffer], others: Sequence[GBuffer]) -> bool:
    return all(
        one.derived == other.derived
        and one.warnings == other.warnings
        and one.mapped == other.mapped
        and np.array_equal(one.background, other.background)
        and one.attributes.keys() == other.attributes.keys()
        and all(np.array_equal(a, other.attributes[name]) for name, a in one.attributes.items())
        for one, other in zip(some, others, strict=True)
    )
