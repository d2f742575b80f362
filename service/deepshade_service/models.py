"""The bundles that this service has, and the engines in memory."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deepshade import versions
from deepshade.bench import noise
from deepshade.bundles import CONFIG, Bundle, bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade.engines import Backend, Engine, available, choose, load_engine
from deepshade.environments import black
from deepshade.errors import DeepshadeError, EngineError, nearest
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

MAX_ENGINES = 12  # in memory, one for each effect and a few; the one used longest ago goes

PROBE = 64  # side of the picture that a bundle is tried out with

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
        self.refused: list[str] = []
        self._threads = threads
        self._pinned = pinned
        self._bundles: dict[str, dict[str, Bundle]] = {}
        self._engines: OrderedDict[Key, Engine] = OrderedDict()
        self._loading: dict[Key, asyncio.Task[Engine]] = {}
        self._speeds: dict[Key, float] = {}
        self._changing = asyncio.Lock()

    async def load(self) -> None:
        """Verify every bundle; what can't be used is left out, loudly. Loads no engine."""
        if not await asyncio.to_thread(available):
            log.error("the service stays unready: no engine is installed")
            return
        async with self._changing:
            self._bundles, self.refused = await self._verified()
        self.ready = bool(self._bundles)
        if not self.ready:
            places = ", ".join(map(str, self.roots))
            log.error("no usable bundle under %s: the service stays unready", places)

    async def reload(self) -> tuple[list[str], dict[str, str]]:
        """Look at the folders again: which bundles changed, and which were refused and why.

        What changed is loaded and tried out before it answers; until then, and where that fails,
        what answered before goes on. Requests in flight end with what they began with.
        """
        async with self._changing:
            found, refused = await self._verified()
            changed, reasons = [], dict.fromkeys(refused, "its files are damaged")
            for label in self._labels() - {
                _label(b) for each in found.values() for b in each.values()
            }:
                if label not in reasons:
                    effect, _, name = label.partition("/")
                    del self._bundles[effect][name]
                    changed.append(label)
            for bundle in (b for each in found.values() for b in each.values()):
                old = self._bundles.get(bundle.effect, {}).get(bundle.name)
                if old is not None and _key(old) == _key(bundle):
                    continue
                try:
                    await self._try_out(bundle, old)
                except (DeepshadeError, Problem) as error:
                    reasons[_label(bundle)] = str(error)
                    continue
                self._take(bundle, old)
                changed.append(_label(bundle))
            self.refused = sorted(reasons)
            self.ready = self.ready or bool(self._bundles)
            return changed, reasons

    async def point(self, alias: versions.Alias, number: int) -> Bundle:
        """Let an alias lead to that version once it is loaded and tried out, and answer with it.

        Raises BundleError, Problem 500 and OSError; the alias and what answers are then as before.
        """
        async with self._changing:
            bundle = await asyncio.to_thread(versions.load, alias.version(number).path)
            old = self._bundles.get(bundle.effect, {}).get(bundle.name)
            await self._try_out(bundle, old)
            await asyncio.to_thread(alias.point, number)
            self._take(bundle, old)
            return bundle

    def alias(self, effect: str, name: str) -> versions.Alias:
        """The alias that this service answers with. Raises Problem 404 where there is none."""
        find_effect(effect)
        for root in self.roots:
            if (root / effect / name / CONFIG).is_file():
                alias = versions.Alias(root, effect, name)
                if alias.current is not None:
                    return alias
                break
        raise Problem(
            404,
            "no-version",
            f"'{effect}/{name[:100]}' has no versions here",
            fix="GET /bundles says which have; a fine-tuned one has them once it is published",
        )

    def _labels(self) -> set[str]:
        return {_label(bundle) for each in self._bundles.values() for bundle in each.values()}

    async def _try_out(self, bundle: Bundle, old: Bundle | None) -> None:
        """Load a bundle where it will run, let it shade, and compile what `old` has compiled.

        Raises EngineError and Problem 500.
        """
        backend = self.backend(bundle)
        engine = await self.engine(bundle, backend)
        sizes = [
            size
            for key, each in self._engines.items()
            for size in each.sizes()
            if old is not None and key[:2] == _key(old)
        ]
        try:
            await asyncio.to_thread(_probe, engine, sizes)
        except Exception as error:
            self._engines.pop((*_key(bundle), backend), None)
            log.exception("bundle %s fails its probe on %s", _label(bundle), backend)
            raise Problem(
                500,
                "bad-bundle",
                f"the bundle '{_label(bundle)}' fails its probe on {backend}: {error}",
            ) from error

    def _take(self, bundle: Bundle, old: Bundle | None) -> None:
        """From now on this bundle answers; what runs still holds the engine that it runs on."""
        self._bundles.setdefault(bundle.effect, {})[bundle.name] = bundle
        for key in list(self._engines) if old is not None else ():
            if old is not None and key[:2] == _key(old) != _key(bundle):
                del self._engines[key]
        log.info("bundle %s is now %s, from %s", _label(bundle), bundle.short_hash, bundle.path)

    async def _verified(self) -> tuple[dict[str, dict[str, Bundle]], list[str]]:
        """The sound bundles of the folders, and the labels of the others."""
        refused = []
        found: dict[str, dict[str, Bundle]] = {}
        folders = bundle_folders(*self.roots)
        for hidden in (f for root in self.roots for f in bundle_folders(root) if f not in folders):
            log.warning("%s isn't served: a folder named before has that bundle too", hidden)
        for folder in folders:
            label = f"{folder.parent.name}/{folder.name}"
            try:
                bundle = await asyncio.to_thread(versions.load, folder)
            except (DeepshadeError, OSError) as error:
                refused.append(label)
                log.error("bundle %s from %s is refused: %s", label, folder.parents[1], error)
                continue
            found.setdefault(bundle.effect, {})[bundle.name] = bundle
            if not self.ready:
                log.info("bundle %s (%s) from %s", label, bundle.short_hash, folder.parents[1])
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
        key = (*_key(bundle), backend)
        if key in self._engines:
            self._engines.move_to_end(key)
            return self._engines[key]
        if key not in self._loading:
            self._loading[key] = asyncio.create_task(self._load(key, bundle))
        return await asyncio.shield(self._loading[key])

    async def ms_per_megapixel(self, bundle: Bundle, backend: Backend) -> float:
        """What the network takes, as timed while it warms up, when that is first asked: never
        anew, so that the same request gets the same bundle."""
        key = (*_key(bundle), backend)
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
        label, backend = _label(bundle), key[-1]
        try:
            engine = await asyncio.to_thread(load_engine, bundle, backend, threads=self._threads)
        except Exception as error:  # libraries raise what they like
            log.exception("bundle %s can't be loaded on %s", label, backend)
            raise Problem(
                500,
                "bad-bundle",
                f"the bundle '{label}' can't be loaded on {backend}; the service's log says why",
                fix="choose another ?bundle= or ?engine=, or export the bundle again",
            ) from error
        finally:
            del self._loading[key]
        log.info("bundle %s is loaded on %s", label, backend)
        self._engines[key] = engine
        if len(self._engines) > MAX_ENGINES:
            self._engines.popitem(last=False)
        return engine


def _label(bundle: Bundle) -> str:
    return f"{bundle.effect}/{bundle.name}"


def _key(bundle: Bundle) -> tuple[Path, str]:
    return bundle.path, bundle.sha256


def _probe(engine: Engine, sizes: Sequence[tuple[int, int]]) -> None:
    """Raises EngineError for answers that aren't finite; what the engine raises for others."""
    bundle = engine.bundle
    side = -(-PROBE // bundle.size_multiple) * bundle.size_multiple
    given = (black(bundle.environment),) if bundle.environment else ()
    if not np.isfinite(engine.predict(noise(bundle, side, side), *given)).all():
        raise EngineError("it gives numbers that aren't finite")
    for height, width in sizes:
        if not (height % bundle.size_multiple or width % bundle.size_multiple):
            engine.prepare(height, width)


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
