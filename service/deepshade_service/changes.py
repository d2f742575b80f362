"""Bundles that change while others are shaded: loaded and tried out first, and only then used."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

import numpy as np

from deepshade import versions
from deepshade.bench import noise
from deepshade.bundles import CONFIG, Bundle
from deepshade.engines import Engine
from deepshade.environments import black
from deepshade.errors import DeepshadeError, EngineError
from deepshade_service.models import Models, find_effect, key_of, label
from deepshade_service.problems import Problem

log = logging.getLogger("deepshade.service")

PROBE = 64  # side of the picture that a bundle is tried out with


class Changes:
    """Changes the bundles of `models`, one change at a time."""

    def __init__(self, models: Models) -> None:
        self._models = models
        self._one = asyncio.Lock()

    async def reload(self) -> tuple[list[str], dict[str, str]]:
        """Look at the folders again: which bundles changed, and which were refused and why.

        What changed is loaded and tried out before it answers; until then, and where that fails,
        what answered before goes on. Requests in flight end with what they began with.
        """
        async with self._one:
            models = self._models
            found, refused = await models.verified()
            reasons = dict.fromkeys(refused, "its files are damaged")
            changed = []
            new = {label(b): b for each in found.values() for b in each.values()}
            old = {label(b): b for b in models.every()}
            for name in old.keys() - new.keys() - reasons.keys():
                models.drop(old[name])
                changed.append(name)
            for name, bundle in new.items():
                before = old.get(name)
                if before is None or key_of(before) != key_of(bundle):
                    try:
                        await self._try_out(bundle, before)
                    except (DeepshadeError, Problem) as error:
                        reasons[name] = str(error)
                        continue
                    changed.append(name)
                models.take(bundle)
            models.refused = sorted(reasons)
            return changed, reasons

    async def point(self, alias: versions.Alias, number: int) -> None:
        """Let an alias lead to that version once it is loaded and tried out, and answer with it.

        Raises BundleError, Problem 500 and OSError; the alias and what answers are then as before.
        """
        async with self._one:
            bundle = await asyncio.to_thread(versions.load, alias.version(number).path)
            before = {label(b): b for b in self._models.every()}.get(label(bundle))
            await self._try_out(bundle, before)
            await asyncio.to_thread(alias.point, number)
            self._models.take(bundle)

    def alias(self, effect: str, name: str) -> versions.Alias:
        """The alias that the service answers with. Raises Problem 404 where there is none."""
        find_effect(effect)
        for root in self._models.roots:
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

    async def _try_out(self, bundle: Bundle, before: Bundle | None) -> None:
        """Load a bundle where it will run, let it shade, and compile what `before` has compiled.

        Raises EngineError and Problem 500.
        """
        backend = self._models.backend(bundle)
        engine = await self._models.engine(bundle, backend)
        sizes = self._models.sizes(before) if before is not None else []
        try:
            await asyncio.to_thread(probe, engine, sizes)
        except Exception as error:  # libraries raise what they like
            self._models.forget(bundle, backend)
            log.exception("bundle %s fails its probe on %s", label(bundle), backend)
            detail = f"the bundle '{label(bundle)}' fails its probe on {backend}: {error}"
            raise Problem(500, "bad-bundle", detail) from error


def probe(engine: Engine, sizes: Sequence[tuple[int, int]]) -> None:
    """Raises EngineError for answers that aren't finite, and what the engine raises."""
    bundle = engine.bundle
    side = -(-PROBE // bundle.size_multiple) * bundle.size_multiple
    given = (black(bundle.environment),) if bundle.environment else ()
    if not np.isfinite(engine.predict(noise(bundle, side, side), *given)).all():
        raise EngineError("it gives numbers that aren't finite")
    for height, width in sizes:
        if not (height % bundle.size_multiple or width % bundle.size_multiple):
            engine.prepare(height, width)
