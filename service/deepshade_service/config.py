"""The service's settings, in one place, with defaults that suit the machine it runs on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

from deepshade.bundles import bundle_roots
from deepshade.environments import LIMITS
from deepshade.errors import ConfigError
from deepshade.exr import Limits
from deepshade.machine import cpu_count, memory_bytes

MIB = 2**20
GIB = 2**30


def default_memory() -> int:
    """Half of what the machine or the container has, between 256 MiB and 8 GiB."""
    return min(8 * GIB, max(256 * MIB, memory_bytes() // 2))


def default_uploads() -> int:
    """A quarter of what the machine or the container has, between 256 MiB and 4 GiB."""
    return min(4 * GIB, max(256 * MIB, memory_bytes() // 4))


def default_limits(uploads: int | None = None) -> Limits:
    """The usual limits, but no body larger than half of `uploads`: it is held twice at first."""
    return Limits(body_bytes=min(Limits().body_bytes, (uploads or default_uploads()) // 2))


def environment_limits(limits: Limits) -> Limits:
    """Those of an environment map, where the service's own aren't tighter."""
    least = {f.name: min(getattr(limits, f.name), getattr(LIMITS, f.name)) for f in fields(Limits)}
    return Limits(**least)


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything an operator can set. Sizes are bytes, times are seconds.

    `workers` requests are shaded at a time and `queue` more may wait; the next gets a 429.
    `memory` is what all requests together may use for pixels and networks, above the idle
    service; tiles are cut to fit. `uploads` bounds, besides, the bodies held while they arrive
    (twice their bytes) and wait; 0 is the default for this machine, or what the largest body needs.
    `keep` bounds the uploads that are kept for `keep_seconds` after their last use, so that a
    picture needn't be sent for each change of a setting; 0 is a quarter of `uploads`.
    `engine` and `precision` pin what requests run on that pin nothing themselves; None leaves it
    to the rule (`deepshade.engines.choose`). `environments` is a folder of environment maps, into
    which requests may add more if `environment_uploads`; those prepared may take a quarter of
    `memory` besides. `hosts` are names that the service goes by, `origins` those whose pages may
    use it, beside its own (`guard.Guard`).

    Of live sessions: how many, how many `live_viewers` each, the bytes of a frame, and how many a
    second a publisher may send. `token` is what publishers show, viewers who have no link, and
    whoever changes which bundles answer (`deepshade.tokens`); `beyond` says that other machines can
    reach the service, where live sessions are closed without it.
    """

    models: Path | Sequence[Path] = field(default_factory=bundle_roots)
    environments: Path | None = None
    environment_uploads: bool = False
    engine: str | None = None
    precision: str | None = None
    limits: Limits = field(default_factory=default_limits)
    threads: int = field(default_factory=cpu_count)
    workers: int = 3  # of two, both sometimes wait for a lock, and a CPU is idle
    queue: int = 16
    memory: int = field(default_factory=default_memory)
    uploads: int = 0
    files: int = 32
    keep: int = 0
    keep_seconds: float = 900.0
    body_timeout: float = 60.0
    idle_trim: float = 1.0
    grace: float = 20.0
    hosts: Sequence[str] = ()
    origins: Sequence[str] = ()
    live_sessions: int = 8
    live_viewers: int = 32
    live_frame: int = 64 * MIB
    live_rate: int = 240
    token: str | None = field(default=None, repr=False)
    beyond: bool = False

    def __post_init__(self) -> None:
        most = 2 * self.limits.body_bytes
        if self.uploads == 0:
            object.__setattr__(self, "uploads", max(default_uploads(), most))
        if self.keep == 0:
            object.__setattr__(self, "keep", self.uploads // 4)
        counts = ("threads", "workers", "memory", "uploads", "files", "keep")
        for key in (*counts, "live_frame", "live_rate"):
            _require(key, getattr(self, key) >= 1, "at least 1")
        _require(
            "uploads",
            self.uploads >= most,
            f"at least twice the largest body, {most:,} bytes (--max-uploads, --max-body)",
        )
        _require(
            "environment_uploads",
            self.environments is not None or not self.environment_uploads,
            "off, or there must be a folder for them (--environments)",
        )
        _require("queue", self.queue >= 0, "0 or more")
        for key in ("body_timeout", "idle_trim", "grace", "keep_seconds"):
            _require(key, getattr(self, key) > 0, "more than 0 seconds")


def _require(key: str, ok: bool, range_: str) -> None:
    if not ok:
        raise ConfigError(key, detail=f"the setting '{key}' must be {range_}")
