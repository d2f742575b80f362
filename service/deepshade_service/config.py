"""The service's settings, in one place, with defaults that suit the machine it runs on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from deepshade.errors import ConfigError
from deepshade.exr import Limits
from deepshade.machine import cpu_count, memory_bytes

MIB = 2**20
GIB = 2**30


def default_memory() -> int:
    """Half of what the machine or the container has, between 256 MiB and 8 GiB."""
    return min(8 * GIB, max(256 * MIB, memory_bytes() // 2))


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything an operator can set. Sizes are bytes, times are seconds.

    `workers` requests are shaded at a time and `queue` more may wait; the next gets a 429.
    `memory` is what all requests together may use for pixels and networks, above the idle
    service; tiles are cut to fit. `uploads` bounds the bodies held while they arrive and wait.
    """

    models: Path = Path("models")
    limits: Limits = field(default_factory=Limits)
    threads: int = field(default_factory=cpu_count)
    workers: int = 2
    queue: int = 16
    memory: int = field(default_factory=default_memory)
    uploads: int = 4 * GIB
    files: int = 32
    body_timeout: float = 60.0
    idle_trim: float = 1.0
    grace: float = 20.0

    def __post_init__(self) -> None:
        for key in ("threads", "workers", "memory", "uploads", "files"):
            _require(key, getattr(self, key) >= 1, "at least 1")
        most = self.limits.body_bytes
        _require("uploads", self.uploads >= most, f"at least the largest body, {most:,} bytes")
        _require("queue", self.queue >= 0, "0 or more")
        for key in ("body_timeout", "idle_trim", "grace"):
            _require(key, getattr(self, key) > 0, "more than 0 seconds")


def _require(key: str, ok: bool, range_: str) -> None:
    if not ok:
        raise ConfigError(key, detail=f"the setting '{key}' must be {range_}")
