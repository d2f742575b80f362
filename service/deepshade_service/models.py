"""The bundles that this service has loaded."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.errors import nearest
from deepshade_service.engine import Engine
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")


class Models:
    """Engines by effect and bundle name. `load` blocks; the rest is cheap."""

    def __init__(self, root: Path, *, threads: int) -> None:
        self.root = root
        self.ready = False
        self.refused: list[str] = []
        self._threads = threads
        self._engines: dict[str, dict[str, Engine]] = {}

    def load(self) -> None:
        """Load and warm every bundle under the root; one that can't be used is left out, loudly."""
        for folder in bundle_folders(self.root):
            self._load_one(folder)
        self.ready = bool(self._engines)
        if not self.ready:
            log.error("no usable bundle under %s: the service stays unready", self.root)

    def _load_one(self, path: Path) -> None:
        label = f"{path.parent.name}/{path.name}"
        try:
            bundle = Bundle.load(path)
            engine = Engine(bundle, threads=self._threads)
            engine.warm()
        except Exception as error:
            # Also what ONNX Runtime raises: one bad bundle must not take the others down.
            self.refused.append(label)
            log.error("bundle %s is refused: %s", label, error)
            return
        self._engines.setdefault(bundle.effect, {})[bundle.name] = engine
        log.info(
            "bundle %s (%s) is loaded, %d bytes a pixel",
            label,
            bundle.short_hash,
            engine.bytes_per_pixel,
        )

    def __iter__(self) -> Iterator[Engine]:
        return (engine for named in self._engines.values() for engine in named.values())

    def bundles(self, effect: str) -> list[Engine]:
        """The engines for one effect, its default first."""
        return list(self._engines.get(effect, {}).values())

    def pick(self, effect: str, name: str | None = None) -> Engine:
        """The engine for an effect: the bundle of that name, or the first by name.

        Raises Problem 404 (unknown effect, no such bundle) and 503 (not ready).
        """
        find_effect(effect)
        if not self.ready:
            raise not_ready(self)
        named = self._engines.get(effect, {})
        if not named:
            raise Problem(
                404,
                "no-bundle",
                f"no bundle for the effect '{effect}' is installed here",
                fix=f"put one into the service's models folder as {effect}/<name>/, and restart",
                installed=sorted(self._engines),
            )
        if name is None:
            return next(iter(named.values()))
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
