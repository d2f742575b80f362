"""What all sections of a report share: where things are, and how long to measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deepshade.errors import DeepshadeError
from deepshade.machine import cpu_count, describe, memory_bytes
from deepshade_report.store import Skipped, key_of
from deepshade_report.timing import Pace

if TYPE_CHECKING:
    from deepshade.bundles import Bundle
    from deepshade_report.method import View

_PACKAGES = (
    "deepshade",
    "numpy",
    "onnxruntime",
    "openvino",
    "OpenEXR",
    "isal",
    "mitsuba",
    "pyoidn",
)


def _silent(share: float, doing: str) -> None:
    """Nobody watches."""


@dataclass
class Context:
    """Settings of one report. `seconds` scales every section's time: 1 is the default report.

    `views` is how many held-out views count at most. `advance(share, doing)` hears of progress.
    """

    models: Path
    data: Path
    out: Path
    paper: Path | None = None
    effect: str = "ao"
    threads: int = field(default_factory=cpu_count)
    quick: bool = False
    views: int | None = None
    advance: Callable[[float, str], None] = _silent

    @cached_property
    def served(self) -> list[Bundle]:
        """The bundles of the service. Raises Skipped without one."""
        from deepshade_report.subjects import bundles

        found = bundles(self.models, self.effect)
        if not found:
            raise Skipped(f"no bundle for '{self.effect}' under {self.models} (--models)")
        return found

    @cached_property
    def baseline(self) -> Bundle | None:
        """The paper's network, if there is one."""
        from deepshade_report.subjects import paper_bundle

        return paper_bundle(self.paper, self.models, self.effect)

    @cached_property
    def held_out(self) -> list[View]:
        """The held-out views that show something. Raises Skipped without data."""
        from deepshade_report.views import load_views

        try:
            found = load_views(self.data, self.effect, self.limit)
        except DeepshadeError as error:
            raise Skipped(f"no held-out views: {error} (--data; {error.fix})") from None
        if not found:
            raise Skipped(f"{self.data} holds no view that shows anything (--data)")
        return found

    @property
    def limit(self) -> int | None:
        """Views at most."""
        return self.views if self.views is not None else (2 if self.quick else None)

    def pace(self, seconds: float, *, fewest: int = 5, most: int = 25) -> Pace:
        """A section's time; quick reports take a tenth of it, and two rounds."""
        if self.quick:
            return Pace(seconds / 10, fewest=2, most=5)
        return Pace(seconds, fewest=fewest, most=most)

    def key(self) -> str:
        """Stamps sections: they are reused only for the same bundles, data, machine and length."""
        manifest = self.data / "manifest.json"
        stamp = manifest.stat().st_mtime_ns if manifest.is_file() else 0
        found: list[Any] = []
        for load in (lambda: self.served, lambda: [self.baseline]):
            try:
                found += [(b.name, b.sha256) for b in load() if b]
            except Skipped:
                continue
        return key_of(machine(), found, str(self.data), stamp, self.threads, self.quick, self.views)


def machine() -> dict[str, Any]:
    """The machine and what runs on it, by name and version."""
    import platform

    return {
        "processor": describe(),
        "memory_gib": round(memory_bytes() / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": {name: v for name in _PACKAGES if (v := _version(name))},
    }


def busy_share(seconds: float = 1.0, stat: Path = Path("/proc/stat")) -> float | None:
    """The share of this machine's CPU time, 0 to 1, that others use now; None if it isn't told.

    Looked at while nothing is measured: figures from a busy machine mean little.
    """
    import time

    try:
        before = _ticks(stat)
        time.sleep(seconds)
        after = _ticks(stat)
    except (OSError, ValueError):  # not Linux
        return None
    spent = [b - a for a, b in zip(before, after, strict=True)]
    total = sum(spent)
    return round(1 - (spent[3] + spent[4]) / total, 3) if total > 0 else None


def _ticks(stat: Path) -> list[int]:
    """user, nice, system, idle, iowait, irq, softirq, steal of all CPUs (proc(5))."""
    return [int(value) for value in stat.read_text().split("\n", 1)[0].split()[1:9]]


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
