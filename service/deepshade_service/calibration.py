"""What each backend takes and costs on this machine: measured once, kept in a file.

A measurement's time is a line through two sizes, its error the bundle's own times what the
backend does to it on the bundle's probe. The file is one JSON object; a measurement holds for the
bundle's hash, the backend and its library's version, the processor, the threads, and this module's
`_VERSION`. Anything else in the file stays as it is, so one file serves several services.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from deepshade import probe
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, Backend, Engine, load_engine, usable
from deepshade.errors import DeepshadeError
from deepshade.files import replacing
from deepshade.machine import describe
from deepshade_service.tiles import padded

log = logging.getLogger("deepshade.service")

_VERSION = 2
# The sizes timed, (height, width), and how often and long: the median of several runs each.
_SIZES = ((256, 384), (512, 768))
_RUNS, _SECONDS = 7, 1.5
_MAX_BYTES = 16 << 20


@dataclass(frozen=True, slots=True)
class Measurement:
    """One bundle on one backend of this machine.

    A prediction of n million pixels takes about `fixed_ms + ms_per_megapixel * n`. `dssim` is the
    error to expect on real views, `added` the share of it that the backend adds to the bundle's
    own (0.004 is 0.4 %; below 0 it happens to gain); None where the bundle has no probe.
    """

    backend: Backend
    fixed_ms: float
    ms_per_megapixel: float
    dssim: float | None
    added: float | None

    def ms(self, pixels: int) -> float:
        """Predicted milliseconds of a prediction."""
        return self.fixed_ms + self.ms_per_megapixel * pixels / 1e6


def default_path() -> Path:
    """$XDG_CACHE_HOME/deepshade/calibration.json, ~/.cache where that isn't set."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "deepshade" / "calibration.json"


def chosen_path(option: str) -> Path | None:
    """What `--calibration` says: a file, 'off' (None), or nothing for the default."""
    if option.lower() == "off":
        return None
    return Path(option) if option else default_path()


def published(bundle: Bundle) -> float | None:
    """The bundle's own error: on its real test set, else on its first, else unknown."""
    errors = bundle.metrics.get("error")
    if not isinstance(errors, dict):
        return None
    for name in ("test-real", *errors):
        try:
            return float(errors[name]["exact"]["dssim"])
        except (KeyError, TypeError, ValueError):
            continue
    return None


def published_added(bundle: Bundle, backend: Backend) -> float | None:
    """The largest share of the error that the backend added in the bundle's own tests."""
    tests = bundle.metrics.get("backends")
    found = []
    for test in tests.values() if isinstance(tests, dict) else ():
        with suppress(KeyError, TypeError, ValueError):
            found.append(float(test[str(backend)]["added"]))
    return max(filter(math.isfinite, found), default=None)


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
        """Measure these, and keep and save the results. A backend that fails is logged, not kept.

        Blocks for about four seconds each. Stops early, with what it has, when `cancelled` is set.
        """
        windows = probe.read_probe(bundle)
        base: float | None = None
        done: list[Measurement] = []
        for backend in backends:
            if cancelled is not None and cancelled.is_set():
                break
            try:
                if windows and base is None:
                    exact = load_engine(bundle, REFERENCE, threads=self.threads)
                    base = probe.dssim(exact, windows)
                engine = load_engine(bundle, backend, threads=self.threads)
                found = _measure(engine, windows, base, cancelled)
            except Exception as error:
                # Also what the libraries raise: a backend that fails must not end the service.
                log.warning("%s/%s on %s: %s", bundle.effect, bundle.name, backend, error)
                with self._lock:
                    self._failed.add(self._key(bundle, backend))
                    self.revision += 1
                continue
            if found is None:
                break
            done.append(found)
            self._keep(bundle, found)
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


def _measure(
    engine: Engine,
    windows: list[probe.Window],
    base: float | None,
    cancelled: threading.Event | None,
) -> Measurement | None:
    """None when cancelled."""
    engine.warm()
    bundle, times = engine.bundle, []
    for size in _SIZES:
        if cancelled is not None and cancelled.is_set():
            return None
        height, width = padded(*size, bundle.size_multiple)
        gbuffer = _picture(engine.channels, height, width, windows)
        engine.prepare(height, width)
        times.append((height * width / 1e6, _median_ms(engine, gbuffer)))
    (small, first), (large, second) = times
    slope = max(0.0, (second - first) / (large - small)) if large > small else second / large
    fixed = max(0.0, second - slope * large)
    if fixed == 0:
        slope = second / large
    own = published(bundle)
    added = dssim = None
    if windows and base:
        there = probe.dssim(engine, windows)
        added = there / base - 1
        # Many views tell more than the probe's few; but they weren't shaded on this CPU.
        if (tested := published_added(bundle, engine.backend)) is not None:
            added = max(added, tested)
        dssim = there if own is None else own * (1 + added)
    elif engine.backend == REFERENCE:
        added, dssim = 0.0, own
    return Measurement(engine.backend, fixed, slope, dssim, added)


def _median_ms(engine: Engine, gbuffer: Any) -> float:
    engine.predict(gbuffer)
    taken: list[float] = []
    begin = time.perf_counter()
    while len(taken) < _RUNS and (len(taken) < 2 or time.perf_counter() - begin < _SECONDS):
        start = time.perf_counter()
        engine.predict(gbuffer)
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken))


def _picture(channels: int, height: int, width: int, windows: list[probe.Window]) -> Any:
    """The probe's pixels, repeated; without a probe smooth waves (denormals would be slow)."""
    if windows:
        tile = np.concatenate([gbuffer for gbuffer, _ in windows], axis=2)
        across, down = -(-width // tile.shape[2]), -(-height // tile.shape[1])
        whole = np.tile(tile, (1, down, across))[:, :height, :width]
        return np.ascontiguousarray(whole)[None]
    wave = np.sin(np.arange(height * width, dtype=np.float32) / 50).reshape(height, width)
    return np.stack([wave + k for k in range(channels)])[None].astype(np.float32)


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
    flags = ""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                flags = line
                break
    except OSError:
        pass
    return describe() + sha256(flags.encode()).hexdigest()[:16]


@cache
def _library(engine: str) -> str:
    names = ("openvino",) if engine == "openvino" else ("onnxruntime", "onnxruntime-gpu")
    for name in names:
        try:
            return f"{name} {metadata.version(name)}"
        except metadata.PackageNotFoundError:
            continue
    return engine
