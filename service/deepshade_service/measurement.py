"""Measures what each backend takes and costs a bundle on this machine: in turns, several times.

A machine that does other work, or shares its processor, is slow for seconds at a time. So every
backend is timed in several passes over all of them, and its quietest pass counts: what slows one
pass of one of them doesn't decide which is the fastest.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import probe
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, Backend, Engine, load_engine
from deepshade.machine import cpu_kind, trim
from deepshade_service.tiles import padded

log = logging.getLogger("deepshade.service")

# The sizes timed, (height, width); in each pass the median of several runs, of at least two.
_SIZES = ((256, 384), (512, 768))
_PASSES, _RUNS, _SECONDS = 6, 3, 0.5


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
    """The largest share of the error that the backend added in the bundle's own tests.

    In those on this kind of CPU, or on all kinds where there were none on this one.
    """
    kinds = bundle.metrics.get("backends")
    kinds = kinds if isinstance(kinds, dict) else {}
    return max(
        _added(kinds.get(cpu_kind()), backend)
        or [added for kind in kinds.values() for added in _added(kind, backend)],
        default=None,
    )


def _added(kind: Any, backend: Backend) -> list[float]:
    """What the tests on one kind of CPU found; they come from a file."""
    found = []
    tests = kind.get("tests") if isinstance(kind, dict) else None
    for test in tests.values() if isinstance(tests, dict) else ():
        with suppress(KeyError, TypeError, ValueError):
            found.append(float(test[str(backend)]["added"]))
    return list(filter(math.isfinite, found))


def measure(
    bundle: Bundle,
    backends: Iterable[Backend],
    *,
    threads: int,
    cancelled: threading.Event | None = None,
) -> dict[Backend, Measurement | None]:
    """Each backend's measurement, None for one that fails, which is logged.

    Blocks for about four seconds each; empty when `cancelled` was set meanwhile. All engines are
    in memory at once, but only one with what a prediction needs.
    """
    stopped = cancelled or threading.Event()
    windows = probe.read_probe(bundle)
    base: float | None = None
    found: dict[Backend, Measurement | None] = {}
    subjects: list[_Subject] = []

    def failed(backend: Backend, error: Exception) -> None:
        # Also what the libraries raise: a backend that fails must not end the service.
        log.warning("%s/%s on %s: %s", bundle.effect, bundle.name, backend, error)
        found[backend] = None

    for backend in backends:
        if stopped.is_set():
            return {}
        try:
            if windows and base is None:
                base = probe.dssim(load_engine(bundle, REFERENCE, threads=threads), windows)
            subjects.append(_Subject(bundle, backend, threads, windows, base))
        except Exception as error:
            failed(backend, error)
    for turn in range(_PASSES):
        for subject in subjects[:: -1 if turn % 2 else 1]:
            if stopped.is_set():
                return {}
            if subject.backend not in found:
                try:
                    subject.time()
                except Exception as error:
                    failed(subject.backend, error)
    return found | {
        subject.backend: subject.result() for subject in subjects if subject.backend not in found
    }


class _Subject:
    """A bundle on one backend, its error, and its milliseconds in each pass at each size."""

    def __init__(
        self,
        bundle: Bundle,
        backend: Backend,
        threads: int,
        windows: Sequence[probe.Window],
        base: float | None,
    ) -> None:
        self.backend = backend
        self._engine = load_engine(bundle, backend, threads=threads)
        self._engine.warm()
        self._windows = windows
        self._sizes = [padded(*size, bundle.size_multiple) for size in _SIZES]
        self._times: list[list[float]] = [[] for _ in self._sizes]
        own = published(bundle)
        self._dssim, self._added = None, None
        if windows and base:
            there = probe.dssim(self._engine, windows)
            added = there / base - 1
            # Many views tell more than the probe's few; but they weren't shaded here.
            if (tested := published_added(bundle, backend)) is not None:
                added = max(added, tested)
            self._added, self._dssim = added, there if own is None else own * (1 + added)
        elif backend == REFERENCE:
            self._added, self._dssim = 0.0, own
        self._engine.shrink()

    def time(self) -> None:
        """One pass."""
        for (height, width), times in zip(self._sizes, self._times, strict=True):
            self._engine.prepare(height, width)  # here, where its memory is given back
            gbuffer = _picture(self._engine.channels, height, width, self._windows)
            times.append(_median_ms(self._engine, gbuffer))
        self._engine.shrink()
        trim()

    def result(self) -> Measurement:
        """A line through the quietest pass at each size."""
        small, large = (height * width / 1e6 for height, width in self._sizes)
        first, second = map(min, self._times)
        slope = max(0.0, (second - first) / (large - small)) if large > small else second / large
        fixed = max(0.0, second - slope * large)
        if fixed == 0:
            slope = second / large
        return Measurement(self.backend, fixed, slope, self._dssim, self._added)


def _median_ms(engine: Engine, gbuffer: NDArray[np.float32]) -> float:
    engine.predict(gbuffer)
    taken: list[float] = []
    begin = time.perf_counter()
    while len(taken) < _RUNS and (len(taken) < 2 or time.perf_counter() - begin < _SECONDS):
        start = time.perf_counter()
        engine.predict(gbuffer)
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken))


def _picture(
    channels: int, height: int, width: int, windows: Sequence[probe.Window]
) -> NDArray[np.float32]:
    """The probe's pixels, repeated; without a probe smooth waves (denormals would be slow)."""
    if windows:
        tile = np.concatenate([gbuffer for gbuffer, _ in windows], axis=2)
        across, down = -(-width // tile.shape[2]), -(-height // tile.shape[1])
        whole: Any = np.tile(tile, (1, down, across))[:, :height, :width]
        return np.ascontiguousarray(whole)[None]
    wave = np.sin(np.arange(height * width, dtype=np.float32) / 50).reshape(height, width)
    return np.stack([wave + k for k in range(channels)])[None].astype(np.float32)
