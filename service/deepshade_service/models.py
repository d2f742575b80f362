"""The bundles that this service has, and the engines in memory."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend, Engine, available, choose, load_engine
from deepshade.errors import DeepshadeError, EngineError, nearest
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

MAX_ENGINES = 12  # in memory, one for each effect and a few; the one used longest ago goes

Key = tuple[Path, Backend]


class Models:
    """Bundles by effect and name, and engines for them, each loaded when it is first asked for.

    `pinned` is the engine and the precision of every request that pins nothing itself. Only for
    use on the event loop; what blocks is done in threads.
    """

    def __init__(
        self,
        roots: Path | Sequence[Path],
        *,
        threads: int,
        pinned: tuple[str | None, str | None] = (None, None),
    ) -> None:
        self.roots = (roots,) if isinstance(roots, Path) else tuple(roots)
        self.ready = False
        self.refused: list[str] = []
        self._threads = threads
        self._pinned = pinned
        self._bundles: dict[str, dict[str, Bundle]] = {}
        self._engines: OrderedDict[Key, Engine] = OrderedDict()
        self._loading: dict[Key, asyncio.Task[Engine]] = {}
        self._speeds: dict[Key, float] = {}

    async def load(self) -> None:
        """Verify every bundle; what can't be used is left out, loudly. Loads no engine."""
        if not await asyncio.to_thread(available):
            log.error("the service stays unready: no engine is installed")
            return
        found: dict[str, dict[str, Bundle]] = {}
        folders = bundle_folders(*self.roots)
        for hidden in (f for root in self.roots for f in bundle_folders(root) if f not in folders):
            log.warning("%s isn't served: a folder named before has that bundle too", hidden)
        for folder in folders:
            label = f"{folder.parent.name}/{folder.name}"
            try:
                bundle = await asyncio.to_thread(Bundle.load, folder)
            except (DeepshadeError, OSError) as error:
                self.refused.append(label)
                log.error("bundle %s from %s is refused: %s", label, folder.parents[1], error)
                continue
            found.setdefault(bundle.effect, {})[bundle.name] = bundle
            log.info("bundle %s (%s) from %s", label, bundle.short_hash, folder.parents[1])
        self._bundles = found
        self.ready = bool(found)
        if not found:
            places = ", ".join(map(str, self.roots))
            log.error("no usable bundle under %s: the service stays unready", places)

    def bundles(self, effect: str) -> list[Bundle]:
        """The bundles of one effect, the one with the least error first; [] while loading."""
        return sorted(self._bundles.get(effect, {}).values(), key=_error)

    def find(self, effect: str, name: str | None = None) -> list[Bundle]:
        """The bundles of one effect, by error, or the one of that name.

        Raises Problem 404 (unknown effect, no bundle) and 503 (not ready).
        """
        find_effect(effect)
        if not self.ready:
            raise not_ready(self)
        bundles = self.bundles(effect)
        names = [bundle.name for bundle in bundles]
        if not bundles:
            raise Problem(
                404,
                "no-bundle",
                f"no bundle for the effect '{effect}' is installed here",
                fix=f"put one into the service's models folder as {effect}/<name>/, and restart",
                installed=sorted(self._bundles),
            )
        if name is not None and name not in names:
            close = nearest(name, names)
            raise Problem(
                404,
                "no-bundle",
                f"the effect '{effect}' has no bundle '{name[:100]}' here",
                fix=f"did you mean '{close}'?" if close else "leave out ?bundle=",
                installed=sorted(names),
            )
        return [bundle for bundle in bundles if name in (None, bundle.name)]

    def backend(
        self, bundle: Bundle, engine: str | None = None, precision: str | None = None
    ) -> Backend:
        """What a request with these pins runs on, by rule. Raises EngineError if it isn't here."""
        pins = (engine, precision) if engine or precision else self._pinned
        return choose(bundle, *pins)

    async def engine(self, bundle: Bundle, backend: Backend) -> Engine:
        """The bundle's engine. Who asks while it is loaded waits for that one.

        Raises Problem 500 when a library refuses the graph.
        """
        key = bundle.path, backend
        if key in self._engines:
            self._engines.move_to_end(key)
            return self._engines[key]
        if key not in self._loading:
            self._loading[key] = asyncio.create_task(self._load(key, bundle))
        return await asyncio.shield(self._loading[key])

    async def ms_per_megapixel(self, bundle: Bundle, backend: Backend) -> float:
        """What the network takes, as timed while it warms up, when that is first asked: never
        anew, so that the same request gets the same bundle."""
        key = bundle.path, backend
        if key not in self._speeds:
            engine = await self.engine(bundle, backend)
            await asyncio.to_thread(engine.warm)
            runs = 3 if bundle.per_channel else 1
            self._speeds.setdefault(key, runs * engine.ms_per_megapixel)
        return self._speeds[key]

    def engines(self) -> list[Engine]:
        """Those in memory."""
        return list(self._engines.values())

    async def _load(self, key: Key, bundle: Bundle) -> Engine:
        label = f"{bundle.effect}/{bundle.name}"
        try:
            engine = await asyncio.to_thread(load_engine, bundle, key[1], threads=self._threads)
        except Exception as error:  # libraries raise what they like
            log.exception("bundle %s can't be loaded on %s", label, key[1])
            raise Problem(
                500,
                "bad-bundle",
                f"the bundle '{label}' can't be loaded on {key[1]}; the service's log says why",
                fix="choose another ?bundle= or ?engine=, or export the bundle again",
            ) from error
        finally:
            del self._loading[key]
        log.info("bundle %s is loaded on %s", label, key[1])
        self._engines[key] = engine
        if len(self._engines) > MAX_ENGINES:
            self._engines.popitem(last=False)
        return engine


def _error(bundle: Bundle) -> tuple[float, str]:
    """Known errors first; then by name."""
    return (float("inf") if bundle.dssim is None else bundle.dssim), bundle.name


def check_backend(engine: str | None, precision: str | None) -> None:
    """Raises EngineError when nothing on this machine is as asked."""
    asked = [("engine", engine), ("precision", precision)]
    for backend in available():
        if all(value in (None, getattr(backend, name)) for name, value in asked):
            return
    raise EngineError(
        f"no '{engine or '*'}/{precision or '*'}' on this machine",
        fix=f"one of: {', '.join(map(str, available()))}",
    )


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


def find_effects(names: str) -> list[Effect]:
    """The effects of a list such as "ao,gi"; Problem 404 for an unknown one, 422 for one twice."""
    effects = [find_effect(name) for name in names.split(",")]
    for effect in effects:
        if effects.count(effect) > 1:
            raise Problem(
                422,
                "bad-parameter",
                f"the effect '{effect.name}' is asked for {effects.count(effect)} times",
                fix="name each effect once",
            )
    return effects


def not_ready(models: Models) -> Problem:
    """Problem 503: still loading, or nothing to serve."""
    return Problem(
        503,
        "not-ready",
        "the service isn't ready: its bundles are still being verified, or there are none",
        headers={"Retry-After": "2"},
        refused=sorted(models.refused),
    )
