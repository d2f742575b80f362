"""The most that one image from a stranger may hold."""

from __future__ import annotations

from dataclasses import dataclass

from deepshade.errors import LimitError


@dataclass(frozen=True, slots=True)
class Limits:
    """The most that one image may hold. `pixels` is for each part, the rest for the file."""

    body_bytes: int = 2 * 1024**3
    decoded_bytes: int = 4 * 1024**3
    pixels: int = 8192 * 8192
    parts: int = 64
    channels: int = 1024

    def check(self, limit: str, value: int) -> None:
        """Raises LimitError when `value` exceeds the limit of that name."""
        maximum = getattr(self, limit)
        if value > maximum:
            raise LimitError(limit, value, maximum)
