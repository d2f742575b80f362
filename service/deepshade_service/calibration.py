"""What each backend takes and costs on this machine: measured once, kept in a file.

The file is one JSON object; a measurement holds for the
bundle's hash, the backend and its library's version, the processor, the threads, and this module's
`_VERSION`. Anything else in the file stays as it is, so one file serves several services.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
from collections.abc import Iterable
from dataclasses import asdict
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle
from deepshade.engines import Backend, usable
from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade.machine import cpu_flags, describe
from deepshade_service.measurement import Measurement, measure

log = logging.getLogger("deepshade.service")

_VERSION = 3
_MAX_BYTES = 16 << 20


def default_path() -> Path:
    """$XDG_CACHE_HOME/deepshade/calibration.json, ~/.cache where that isn't set."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "deepshade" / "calibration.json"


def chosen_path(option: str) -> Path | None:
    """What `--calibration` says: a file, 'off' (None), or nothing for the default."""
    if option.lower() == "off":
        return None
    return Path(option) if option else default_path()


class Calibration:
    """The measurements in a file, or in memory alone when `path` is None."""

    def __init__(self, path: Path | None, *, threads: int) -> None:
        self.path = path
        self.threads = threads
        self._lock = threading.Lock()
        self.revision = 0  # counts what was added, for those who keep conclusions
        self._failed: set[str] = set()
        self._found: dict[str, Any] = {}
        if path is not None:
            self._found = _read(path)

    def get(self, bundle: Bundle, backend: Backend) -> Measurement | None:
        """What is known, None if it was never measured here."""
        with self._lock:
            stored = self._found.get(self._key(bundle, backend))
        try:
            return None if stored is None else _parse(backend, stored)
        except (KeyError, TypeError, ValueError):  # someone else's, or damaged: measure again
            return None

    def all(self, bundle: Bundle) -> list[Measurement]:
        """What is known of a bundle."""
        found = (self.get(bundle, backend) for backend in usable(bundle))
        return [one for one in found if one is not None]

    def missing(self, bundle: Bundle) -> list[Backend]:
        """What of this machine was not measured yet, `REFERENCE` first."""
        return [
            backend
            for backend in usable(bundle)
            if self.get(bundle, backend) is None and not self.failed(bundle, backend)
        ]

    def failed(self, bundle: Bundle, backend: Backend) -> bool:
        """Whether it could not be measured in this process; another one will try again."""
        with self._lock:
            return self._key(bundle, backend) in self._failed

    def measure(
        self, bundle: Bundle, backends: Iterable[Backend], cancelled: threading.Event | None = None
    ) -> list[Measurement]:
        """Measure these, and keep and save the results. A backend that fails is noted, not kept.

        Blocks for about four seconds each; keeps nothing when `cancelled` is set meanwhile.
        """
        done = []
        measured = measure(bundle, backends, threads=self.threads, cancelled=cancelled)
        for backend, found in measured.items():
            if found is None:
                with self._lock:
                    self._failed.add(self._key(bundle, backend))
                    self.revision += 1
            else:
                self._keep(bundle, found)
                done.append(found)
        return done

    def _keep(self, bundle: Bundle, found: Measurement) -> None:
        entry = {k: v for k, v in asdict(found).items() if k != "backend"}
        entry |= {"bundle": f"{bundle.effect}/{bundle.name}", "on": str(found.backend)}
        entry |= {"machine": describe(), "threads": self.threads}
        key = self._key(bundle, found.backend)
        with self._lock:
            self.revision += 1
            if self.path is None:
                self._found[key] = entry
                return
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                # Another process may have added to it meanwhile.
                self._found = {**self._found, **_read(self.path), key: entry}
                with replacing(self.path) as temporary:
                    temporary.write_text(json.dumps(self._found, indent=1) + "\n", "utf-8")
            except OSError as error:
                self._found[key] = entry
                log.warning("can't keep the calibration in %s: %s", self.path, error.strerror)

    def _key(self, bundle: Bundle, backend: Backend) -> str:
        graphs = [bundle.hashes.get(name, "") for name in sorted(bundle.hashes)]
        facts = (_VERSION, _machine(), _library(backend.engine), str(backend), self.threads, graphs)
        return sha256(repr(facts).encode()).hexdigest()[:32]


def _parse(backend: Backend, stored: dict[str, Any]) -> Measurement:
    """Raises KeyError, TypeError or ValueError for what no measurement looks like."""

    def number(name: str) -> float:
        value = stored[name]
        if isinstance(value, bool) or not math.isfinite(value):
            raise ValueError(name)
        return float(value)

    def known(name: str) -> float | None:
        return None if stored[name] is None else number(name)

    times = number("fixed_ms"), number("ms_per_megapixel")
    return Measurement(backend, *times, known("dssim"), known("added"))


def _read(path: Path) -> dict[str, Any]:
    """The file's entries; none if it is absent, damaged or no calibration."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DeepshadeError(f"{path} is too large")
        found = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError, DeepshadeError) as error:
        log.warning("the calibration %s can't be read and is made anew: %s", path, error)
        return {}
    return found if isinstance(found, dict) else {}


@cache
def _machine() -> str:
    """The processor with all its instructions: the same name may come with fewer of them."""
    return describe() + sha256(" ".join(sorted(cpu_flags())).encode()).hexdigest()[:16]


@cache
def _library(engine: str) -> str:
    names = ("openvino",) if engine == "openvino" else ("onnxruntime", "onnxruntime-gpu")
    for name in names:
        try:
            return f"{name} {metadata.version(name)}"
        except metadata.PackageNotFoundError:
            continue
    return engine
