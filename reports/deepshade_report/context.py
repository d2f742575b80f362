"""What all sections of a report share: where things are, how long to measure, and the machine."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle
from deepshade.errors import ConfigError
from deepshade.machine import cpu_count, describe, memory_bytes
from deepshade_report.method import bundles, paper_bundle
from deepshade_report.timing import Pace
from deepshade_report.view import View, load_views

_PACKAGES = ("deepshade", "numpy", "onnxruntime", "openvino", "OpenEXR", "mitsuba", "mitsuba-oidn")


@dataclass
class Context:
    """Settings of one report.

    `max_views` is how many held-out views count at most. `advance(share, doing)` hears of progress.
    `measured` are the sections that are done.
    """

    models: Path
    data: Path
    out: Path
    paper: Path | None = None
    effect: str = "ao"
    threads: int = field(default_factory=cpu_count)
    quick: bool = False
    max_views: int | None = None
    advance: Callable[[float, str], None] = lambda share, doing: None
    measured: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def served(self) -> list[Bundle]:
        """The bundles of the service. Raises ConfigError without one."""
        found = bundles(self.models, self.effect)
        if not found:
            detail = f"{self.models} holds no bundle for '{self.effect}'"
            raise ConfigError("models", detail=f"{detail}: train and export one, or set --models")
        return found

    @cached_property
    def paper_network(self) -> Bundle | None:
        """The paper's network, if there is one."""
        return paper_bundle(self.paper, self.models, self.effect)

    @cached_property
    def views(self) -> list[View]:
        """The held-out views that show something. Raises DataError without."""
        limit = self.max_views or (2 if self.quick else None)
        return load_views(self.data, self.effect, limit)

    def pace(self, seconds: float, *, min_rounds: int = 5, max_rounds: int = 25) -> Pace:
        """A section's time; quick reports take a tenth of it, and two rounds."""
        return Pace(seconds / 10, 2, 5) if self.quick else Pace(seconds, min_rounds, max_rounds)

    def key(self) -> str:
        """Stamps sections: they are kept only for the same bundles, data, machine and settings."""
        hashes = [b.sha256 for b in (*self.served, self.paper_network) if b]
        manifest = hashlib.sha256((self.data / "manifest.json").read_bytes()).hexdigest()
        facts = machine(), hashes, manifest, self.threads, self.quick, self.max_views
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


def machine() -> dict[str, Any]:
    """The machine and what runs on it, by name and version."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "processor": describe(),
        "memory_gib": round(memory_bytes() / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": versions,
    }
