"""What a report has measured so far: one JSON file a section, so that a stop loses only one."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deepshade.files import replacing

FORMAT = "deepshade-report"
VERSION = 1
DONE, SKIPPED = "done", "skipped"
FOLDER = "sections"

Section = dict[str, Any]


class Skipped(Exception):
    """A section can't be measured here; the message says why, for the page."""


class Store:
    """The sections of the report in `folder`.

    Each is stamped with `key`, what it was measured with (see `key_of`); `load` gives only what
    bears the same stamp.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / FOLDER
        self.key = key

    def load(self, name: str) -> Section | None:
        """A stored section, or None: absent, unreadable, or measured with something else."""
        try:
            section = json.loads((self.folder / f"{name}.json").read_text("utf-8"))
        except (OSError, ValueError):
            return None
        if not isinstance(section, dict) or "status" not in section:
            return None
        return section if section.get("key") == self.key else None

    def done(
        self, name: str, data: Mapping[str, Any], seconds: float, busy: float | None = None
    ) -> Section:
        """Keep what was measured, and the share of the CPUs that others used before it."""
        section = {"status": DONE, "seconds": round(seconds, 1), "busy_before": busy}
        return self._write(name, section | {"data": finite(data)})

    def skipped(self, name: str, reason: str) -> Section:
        """Keep why nothing was measured."""
        return self._write(name, {"status": SKIPPED, "reason": reason})

    def _write(self, name: str, section: Section) -> Section:
        section["key"] = self.key
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / f"{name}.json", section)
        return section


def key_of(*facts: object) -> str:
    """A short stamp of everything that the figures depend on."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:16]


def write_json(path: Path, document: object) -> None:
    """Replace a JSON file atomically. Raises ValueError for NaN and infinities."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", "utf-8")


def finite(value: Any) -> Any:
    """The same data as JSON knows it: tuples as lists, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
