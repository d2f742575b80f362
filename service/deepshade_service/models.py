"""The bundles that this service has, and the engines in memory."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

from deepshade import versions
from deepshade.bundles import Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend, Engine, available, choose, load_engine
from deepshade.errors import DeepshadeError, EngineError, nearest
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

MAX_ENGINES = 12  # in memory, one for each effect and a few; the one used longest ago goes

Bundles = dict[str, dict[str, Bundle]]  # by effect and name
Key = tuple[Path, str, Backend]  # a bundle's real folder and hash, and what it runs on


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
        self.loaded = False  # whether all were looked at, if only to find none
        self.refused: list[str] = []
        self._threads = threads
        self._pinned = pinned
        self._bundles: Bundles = {}
        self._engines: OrderedDict[Key, Engine] = OrderedDict()
        self._loading: dict[Key, asyncio.Task[Engine]] = {}
        self._speeds: dict[Key, float] = {}

    async def load(self) -> None:
        """Verify every bundle; what can't be used is left out, loudly. Loads no engine."""
        if not await asyncio.to_thread(available):
            log.error("the service stays unready: no engine is installed")
            return
        self._bundles, self.refused = await self.verified()
        self.ready, self.loaded = bool(self._bundles), True
        if not self.ready:
            places = ", ".join(map(str, self.roots))
            log.error("no usable bundle under %s: the service stays unready", places)

    def every(self) -> list[Bundle]:
        """All bundles that answer."""
        return _all(self._bundles)

    def take(self, bundle: Bundle) -> None:
        """From now on this bundle answers; what runs still holds the engine that it runs on."""
        known = self._bundles.setdefault(bundle.effect, {})
        old, known[bundle.name] = known.get(bundle.name), bundle
        if old is not None and key_of(old) != key_of(bundle):
            for key in [key for key in self._engines if key[:2] == key_of(old)]:
                del self._engines[key]
            log.info("bundle %s is now %s, from %s", label(bundle), bundle.short_hash, bundle.path)
        self.ready = True

    def drop(self, bundle: Bundle) -> None:
        """From now on nothing answers under its name."""
        del self._bundles[bundle.effect][bundle.name]

    def forget(self, bundle: Bundle, backend: Backend) -> None:
        """Don't keep its engine."""
        self._engines.pop((*key_of(bundle), backend), None)

    def sizes(self, bundle: Bundle) -> list[tuple[int, int]]:
        """The (height, width) that its engines have compiled."""
        mine = [each for key, each in self._engines.items() if key[:2] == key_of(bundle)]
        return [size for engine in mine for size in engine.sizes()]

    async def verified(self) -> tuple[Bundles, list[str]]:
        """The sound bundles of the folders, and the labels of the others."""
        refused = []
        found: Bundles = {}
        folders = bundle_folders(*self.roots)
        every = (f for root in self.roots for f in bundle_folders(root))
        for hidden in (f for f in every if f not in folders and not self.ready):
            log.warning("%s isn't served: a folder named before has that bundle too", hidden)
        for folder in folders:
            name = f"{folder.parent.name}/{folder.name}"
            try:
                bundle = await asyncio.to_thread(versions.load, folder)
            except (DeepshadeError, OSError) as error:
                refused.append(name)
                log.error("bundle %s from %s is refused: %s", name, folder.parents[1], error)
                continue
            found.setdefault(bundle.effect, {})[bundle.name] = bundle
            if not self.ready:
                log.info("bundle %s (%s) from %s", name, bundle.short_hash, folder.parents[1])
        return found, refused

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
        key = (*key_of(bundle), backend)
        if key in self._engines:
            self._engines.move_to_end(key)
            return self._engines[key]
        if key not in self._loading:
            self._loading[key] = asyncio.create_task(self._load(key, bundle))
        return await asyncio.shield(self._loading[key])

    async def ms_per_megapixel(self, bundle: Bundle, backend: Backend) -> float:
        """What the network takes, as timed while it warms up, when that is first asked: never
        anew, so that the same request gets the same bundle."""
        key = (*key_of(bundle), backend)
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
        name, backend = label(bundle), key[-1]
        try:
            engine = await asyncio.to_thread(load_engine, bundle, backend, threads=self._threads)
        except Exception as error:  # libraries raise what they like
            log.exception("bundle %s can't be loaded on %s", name, backend)
            raise Problem(
                500,
                "bad-bundle",
                f"the bundle '{name}' can't be loaded on {backend}; the service's log says why",
                fix="choose another ?bundle= or ?engine=, or export the bundle again",
            ) from error
        finally:
            del self._loading[key]
        log.info("bundle %s is loaded on %s", name, backend)
        self._engines[key] = engine
        if len(self._engines) > MAX_ENGINES:
            self._engines.popitem(last=False)
        return engine


def _all(bundles: Bundles) -> list[Bundle]:
    return [bundle for each in bundles.values() for bundle in each.values()]


def label(bundle: Bundle) -> str:
    """Its effect and name, for people."""
    return f"{bundle.effect}/{bundle.name}"


def key_of(bundle: Bundle) -> tuple[Path, str]:
    """What tells it from another of the same name: its real folder and its graph's hash."""
    return bundle.path, bundle.sha256


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
