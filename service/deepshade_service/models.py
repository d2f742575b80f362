"""The bundles that this service has, on what each can run, and the engines in memory."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend, Engine, load_engine
from deepshade.errors import EngineError, nearest
from deepshade_service.calibration import Calibration
from deepshade_service.candidate import Candidate, candidates_of, speed
from deepshade_service.measurement import published
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

# Engines kept in memory beside each bundle's default: those that requests pinned.
_PINNED = 4


class Models:
    """Bundles by effect and name, and engines for them. `load` and `calibrate` block.

    `calibration` is the file that keeps what was measured. Without one (None) every bundle runs
    on the first of `available`, which is ONNX Runtime in fp32, unless a request pins another.
    """

    def __init__(self, root: Path, *, threads: int, calibration: Path | None = None) -> None:
        self.root = root
        self.ready = False
        self.calibrating = False
        self.refused: list[str] = []
        self.calibration = (
            None if calibration is None else Calibration(calibration, threads=threads)
        )
        self._threads = threads
        self._bundles: dict[str, dict[str, Bundle]] = {}
        self._engines: OrderedDict[tuple[Path, Backend], Engine] = OrderedDict()
        self._loading: dict[tuple[Path, Backend], threading.Lock] = {}
        self._lock = threading.Lock()
        self._known: dict[Path, tuple[int, list[Candidate]]] = {}

    def load(self) -> None:
        """Verify every bundle and warm its default; what can't be used is left out, loudly."""
        self.calibrating = self.calibration is not None
        for folder in bundle_folders(self.root):
            self._load_one(folder)
        self.ready = bool(self._bundles)
        if not self.ready:
            self.calibrating = False
            log.error("no usable bundle under %s: the service stays unready", self.root)

    def _load_one(self, path: Path) -> None:
        label = f"{path.parent.name}/{path.name}"
        try:
            bundle = Bundle.load(path)
            engine = self.engine(self._default(bundle))
        except Exception as error:
            # Also what the libraries raise: one bad bundle must not take the others down.
            self.refused.append(label)
            log.error("bundle %s is refused: %s", label, error)
            return
        self._bundles.setdefault(bundle.effect, {})[bundle.name] = bundle
        log.info(
            "bundle %s (%s) is loaded on %s, %d bytes a pixel",
            label,
            bundle.short_hash,
            engine.backend,
            engine.bytes_per_pixel,
        )

    def calibrate(self, cancelled: threading.Event) -> None:
        """Measure what this machine hasn't measured yet, and warm what turns out as default.

        Ends soon after `cancelled` is set. Until a bundle is measured it runs in fp32.
        """
        try:
            if self.calibration is None:
                return
            for bundle in [b for named in self._bundles.values() for b in named.values()]:
                missing = self.calibration.missing(bundle)
                if not missing or cancelled.is_set():
                    continue
                log.info("measuring %s/%s on this machine", bundle.effect, bundle.name)
                self.calibration.measure(bundle, missing, cancelled)
                chosen = self._default(bundle)
                self.engine(chosen)
                log.info("%s/%s runs on %s", bundle.effect, bundle.name, chosen.backend)
        finally:
            self.calibrating = False
            self._drop()

    def __iter__(self) -> Iterator[Engine]:
        """The engines in memory."""
        with self._lock:
            return iter(list(self._engines.values()))

    def bundles(self, effect: str) -> list[Bundle]:
        """The bundles of one effect, the one with the least error first."""
        return sorted(self._bundles.get(effect, {}).values(), key=_error)

    def candidates(self, effect: str) -> list[Candidate]:
        """Every bundle on every backend it can run on: by the bundle's error, its default first.

        Raises Problem 404 (unknown effect, no bundle) and 503 (not ready).
        """
        self._check(effect)
        return [one for bundle in self.bundles(effect) for one in self._of(bundle)]

    def candidate(
        self,
        effect: str,
        name: str | None = None,
        engine: str | None = None,
        precision: str | None = None,
    ) -> Candidate:
        """The best bundle or the one of that name, on its default or on what is pinned.

        With one of `engine` and `precision` pinned it is the fastest of those left (the first
        known, before any is measured). Raises Problem 404 (no such effect or bundle), 422 (no
        such backend here) and 503 (not ready).
        """
        bundle = self._find(effect, name)
        all_ = self._of(bundle)
        fitting = [
            one
            for one in all_
            if engine in (None, one.backend.engine) and precision in (None, one.backend.precision)
        ]
        if not fitting:
            asked = "/".join(part or "*" for part in (engine, precision))
            raise Problem(
                422,
                "no-backend",
                f"the bundle '{bundle.name}' can't run on {asked[:100]} here",
                fix="choose one of `available`, or leave out ?engine= and ?precision=",
                available=[str(one.backend) for one in all_],
            )
        defaults = [one for one in fitting if one.default]
        return defaults[0] if defaults else min(fitting, key=speed)

    def engine(self, candidate: Candidate) -> Engine:
        """The candidate's engine, warm; blocks while it is loaded.

        Raises EngineError, which `usable` backends only do when a library refuses the graph.
        """
        key = candidate.bundle.path, candidate.backend
        with self._lock:
            if key in self._engines:
                self._engines.move_to_end(key)
                return self._engines[key]
            loading = self._loading.setdefault(key, threading.Lock())
        with loading:
            with self._lock:
                if key in self._engines:
                    return self._engines[key]
            engine = load_engine(candidate.bundle, candidate.backend, threads=self._threads)
            engine.warm()
            with self._lock:
                self._engines[key] = engine
        self._drop()
        return engine

    def _drop(self) -> None:
        """Forget the engines that were pinned longest ago; defaults stay."""
        bundles = [b for named in self._bundles.values() for b in named.values()]
        kept = {(bundle.path, self._default(bundle).backend) for bundle in bundles}
        with self._lock:
            others = [key for key in self._engines if key not in kept]
            for key in others[: max(0, len(others) - _PINNED)]:
                del self._engines[key]

    def _of(self, bundle: Bundle) -> list[Candidate]:
        """A bundle's candidates, its default first."""
        revision = -1 if self.calibration is None else self.calibration.revision
        made, candidates = self._known.get(bundle.path, (None, []))
        if made != revision:
            candidates = candidates_of(bundle, self.calibration)
            self._known[bundle.path] = revision, candidates
        return candidates

    def _default(self, bundle: Bundle) -> Candidate:
        candidates = self._of(bundle)
        if not candidates:
            raise EngineError(
                "no engine is installed", fix="pip install 'deepshade[service]', then restart"
            )
        return candidates[0]

    def _check(self, effect: str) -> dict[str, Bundle]:
        find_effect(effect)
        if not self.ready:
            raise not_ready(self)
        named = self._bundles.get(effect, {})
        if not named:
            raise Problem(
                404,
                "no-bundle",
                f"no bundle for the effect '{effect}' is installed here",
                fix=f"put one into the service's models folder as {effect}/<name>/, and restart",
                installed=sorted(self._bundles),
            )
        return named

    def _find(self, effect: str, name: str | None) -> Bundle:
        named = self._check(effect)
        if name is None:
            return self.bundles(effect)[0]
        if name not in named:
            close = nearest(name, named)
            raise Problem(
                404,
                "no-bundle",
                f"the effect '{effect}' has no bundle '{name[:100]}' here",
                fix=f"did you mean '{close}'?" if close else "leave out ?bundle=",
                installed=sorted(named),
            )
        return named[name]


def _error(bundle: Bundle) -> tuple[float, str]:
    """Known errors first; then by name."""
    error = published(bundle)
    return (float("inf") if error is None else error), bundle.name


def find_effect(name: str) -> Effect:
    """The effect of that name; Problem 404 with the nearest one otherwise."""
    if name not in EFFECTS:
        close = nearest(name, EFFECTS)
        raise Problem(
            404,
            "unknown-effect",
            f"there is no effect '{name[:100]}'",
            fix=f"did you mean '{close}'?" if close else "GET /effects lists them",
            effects=sorted(EFFECTS),
        )
    return EFFECTS[name]


def not_ready(models: Models) -> Problem:
    """Problem 503: still loading, or nothing to serve."""
    return Problem(
        503,
        "not-ready",
        "the service isn't ready: its models are still loading, or there are none",
        headers={"Retry-After": "2"},
        refused=sorted(models.refused),
    )
