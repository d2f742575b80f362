"""What all sections of a report share: where things are, how long to measure, and the machine."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle, bundle_folders
from deepshade.errors import ConfigError, DataError
from deepshade.files import sha256
from deepshade.machine import cpu_count, describe, memory_bytes
from deepshade.manifest import NAME
from deepshade.timing import Pace
from deepshade_report.method import PAPER
from deepshade_report.samples import sample_views
from deepshade_report.view import View, load_views

_QUALITIES = ("fast", "balanced", "best")  # of shipped bundles, which come first
_PACKAGES = ("deepshade", "numpy", "onnxruntime", "openvino", "OpenEXR", "mitsuba", "mitsuba-oidn")


@dataclass
class Context:
    """Settings of one report.

    Of bundles in several of the folders `models` the first counts. `max_views` is how many held-out
    views count at most. `advance(share, doing)` hears of progress. `measured` are the sections that
    are done.
    """

    models: Sequence[Path]
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
        """The bundles that the service offers, from fast to best. Raises ConfigError without one.

        Raises BundleError for a damaged one.
        """
        folders = [path for path in bundle_folders(*self.models) if path.parent.name == self.effect]
        found = [Bundle.load(path) for path in folders if path.name != PAPER]
        if not found:
            places = ", ".join(map(str, self.models))
            detail = f"no bundle for '{self.effect}' in {places}"
            raise ConfigError("models", detail=f"{detail}: train and export one, or set --models")
        rank = {name: index for index, name in enumerate(_QUALITIES)}
        return sorted(found, key=lambda bundle: (rank.get(bundle.name, len(rank)), bundle.name))

    @cached_property
    def paper_network(self) -> Bundle | None:
        """The paper's network: what --paper names, else <models>/<effect>/paper, else None.

        Raises BundleError when the named folder holds none.
        """
        places = [root / self.effect / PAPER for root in self.models]
        folder = self.paper or next(filter(Path.is_dir, places), None)
        return Bundle.load(folder) if folder else None

    @cached_property
    def views(self) -> list[View]:
        """The held-out views that show something, or those of a folder of EXR files.

        Raises DataError without.
        """
        limit = self.max_views or (2 if self.quick else None)
        if (self.data / NAME).is_file() or not any(self.data.glob("*.exr")):
            return load_views(self.data, self.effect, limit)
        if found := sample_views(self.data, self.effect)[:limit]:
            return found
        raise DataError(
            f"no EXR file of {self.data} has a reference of '{self.effect}' that shows something",
            fix=f"render one: deepshade render --effects {self.effect}, or datagen for many",
        )

    def pace(self, seconds: float, *, min_rounds: int = 5, max_rounds: int = 25) -> Pace:
        """A section's time; quick reports take a tenth of it, and two rounds."""
        return Pace(seconds / 10, 2, 5) if self.quick else Pace(seconds, min_rounds, max_rounds)

    def options(self) -> dict[str, Any]:
        """What was asked for, as JSON values."""
        asked: dict[str, Any] = {
            "models": [str(path) for path in self.models],
            "data": str(self.data),
            "paper": self.paper and str(self.paper),
        }
        asked |= {"effect": self.effect, "threads": self.threads}
        return asked | {"quick": self.quick, "views": self.max_views}

    def key(self) -> str:
        """Stamps sections: they are kept only for the same bundles, data, machine and settings."""
        hashes = [b.sha256 for b in (*self.served, self.paper_network) if b]
        paths = [self.data / NAME] if (self.data / NAME).is_file() else self.data.glob("*.exr")
        manifest = [sha256(path) for path in sorted(paths)]
        facts = machine(), hashes, manifest, self.threads, self.quick, self.max_views
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]


@cache
def machine() -> dict[str, Any]:
    """The machine and what runs on it, by name and version."""
    versions: dict[str, str] = {}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return {
        "processor": describe(),
        "memory_gib": round(memory_bytes() / 2**30, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "versions": dict(sorted(versions.items())),
    }
