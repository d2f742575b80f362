"""The routes of bundles: which version answers, look again, pin one, go back to the one before."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import FastAPI, Query

from deepshade import versions
from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.errors import BundleError
from deepshade_service.changes import Changes
from deepshade_service.described import errors
from deepshade_service.models import Models, not_ready
from deepshade_service.problems import Problem

_CHANGES = {
    401: "The service's token is needed",
    403: "Without a token this is for the service's own machine",
    404: "No such bundle, or it has no versions",
    409: "It can't be loaded: what answered goes on",
    503: "The bundles aren't verified yet",
}


def guarded(method: str, path: str) -> bool:
    """Whether a request changes what is served, which not everybody may."""
    return path.startswith("/bundles") and method not in ("GET", "HEAD")


def install(app: FastAPI, models: Models) -> None:
    """Add the routes to `app`."""
    changes = Changes(models)

    def ready() -> None:
        if not models.loaded:
            raise not_ready(models)

    @app.get(
        "/bundles",
        tags=["bundles"],
        summary="All bundles, with their versions",
        responses=errors({}),
    )
    async def listed() -> list[dict[str, Any]]:
        """`number` is the version that answers, where a bundle has versions."""
        return [describe(bundle) for e in EFFECTS for bundle in models.bundles(e)]

    @app.post(
        "/bundles/reload",
        tags=["bundles"],
        summary="Look at the folders again",
        responses=errors(_CHANGES),
    )
    async def reload() -> dict[str, Any]:
        """What changed is loaded and tried out before it answers. Whatever can't be loaded is
        refused with a 409, and what answered before goes on."""
        ready()
        changed, refused = await changes.reload()
        if refused:
            raise Problem(
                409,
                "bad-bundle",
                "; ".join(f"{label}: {why}" for label, why in refused.items()),
                fix="what answered before goes on; the service's log says more",
                changed=changed,
                refused=sorted(refused),
            )
        return {"changed": changed}

    @app.post(
        "/bundles/{effect}/{name}/pin",
        tags=["bundles"],
        summary="Stay at one version",
        responses=errors(_CHANGES | {422: "No number of a version"}),
    )
    async def pin(effect: str, name: str, version: Annotated[int, Query(ge=1)]) -> dict[str, Any]:
        """It is loaded and tried out first. Nothing that is published moves the alias then."""
        ready()
        alias = changes.alias(effect, name)
        await _point(changes, alias, lambda: alias.version(version).number)
        await asyncio.to_thread(alias.pin, version)
        return described(models, effect, name)

    @app.delete(
        "/bundles/{effect}/{name}/pin",
        tags=["bundles"],
        summary="Follow again",
        responses=errors(_CHANGES),
    )
    async def unpin(effect: str, name: str) -> dict[str, Any]:
        """What is published next moves the alias again; until then it stays."""
        alias = changes.alias(effect, name)
        await asyncio.to_thread(alias.pin, None)
        return described(models, effect, name)

    @app.post(
        "/bundles/{effect}/{name}/rollback",
        tags=["bundles"],
        summary="Go back by one",
        responses=errors(_CHANGES),
    )
    async def rollback(effect: str, name: str) -> dict[str, Any]:
        """To the version before the one that answers, loaded and tried out first. A pin is lost."""
        ready()
        alias = changes.alias(effect, name)
        await _point(changes, alias, alias.before)
        await asyncio.to_thread(alias.pin, None)
        return described(models, effect, name)


def described(models: Models, effect: str, name: str) -> dict[str, Any]:
    """One bundle, as `GET /bundles` has it."""
    (bundle,) = models.find(effect, name)
    return describe(bundle)


def describe(bundle: Bundle) -> dict[str, Any]:
    """A bundle and its versions as JSON values."""
    found: dict[str, Any] = {
        "effect": bundle.effect,
        "name": bundle.name,
        "sha256": bundle.sha256,
        "dssim": bundle.dssim,
        "number": None,
        "versions": [],
        "pinned": None,
    }
    if bundle.path.parents[1].name != versions.FOLDER:
        return found
    alias = versions.Alias(bundle.path.parents[3], bundle.effect, bundle.name)
    more = {"number": int(bundle.path.name), "versions": alias.numbers(), "pinned": alias.pinned}
    return found | more


async def _point(changes: Changes, alias: versions.Alias, chosen: Callable[[], int]) -> None:
    try:
        number = chosen()
    except BundleError as error:
        raise Problem(422, "no-version", str(error), fix=error.fix) from error
    try:
        await changes.point(alias, number)
    except OSError as error:
        raise Problem(
            409,
            "read-only",
            f"{alias.link} can't be moved: {error.strerror}",
            fix="ask the trainer service to do it: 'deepshade-client pin' and 'rollback'",
        ) from error
