"""How large pictures may be to hold a rate: `--fps`."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

MAX_STEP = 4  # every fourth pixel each way; below that nothing is to be seen
_KEPT = 5
_ROOM, _TIGHT = 0.7, 0.95  # of a frame's time: what must be left to grow, when to shrink


class Pace:
    """Chooses every how many pixels one is shaded, by what each stage takes a pixel."""

    def __init__(self, fps: float) -> None:
        self._seconds = 1 / fps
        self._each: deque[float] = deque(maxlen=_KEPT)  # seconds a pixel
        self.step = 1

    def took(self, pixels: int, took_ms: Mapping[str, float], link: float) -> None:
        """An answer of so many pixels; stages overlap, so the slowest counts."""
        decode = took_ms.get("unpack", 0.0) + took_ms.get("decode", 0.0)
        infer = took_ms.get("plan", 0.0) + took_ms.get("infer", 0.0)
        self._each.append(max(decode / 1e3, infer / 1e3, link) / max(pixels, 1))

    def choose(self, pixels: int) -> int:
        """The step for a picture of so many pixels."""
        if len(self._each) == _KEPT:
            each = sorted(self._each)[_KEPT // 2]
            if each * pixels / self.step**2 > _TIGHT * self._seconds:
                self.step = min(self.step + 1, MAX_STEP)
                self._each.clear()
            elif self.step > 1 and each * pixels / (self.step - 1) ** 2 < _ROOM * self._seconds:
                self.step -= 1
                self._each.clear()
        return self.step
