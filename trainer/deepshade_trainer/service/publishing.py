"""From a job's bundle to a version that is served: publish, move the alias, tell the services."""

from __future__ import annotations

import json
import logging
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from deepshade.bundles import CONFIG, MODEL
from deepshade.errors import BundleError
from deepshade.tracing import carried
from deepshade.versions import Alias, Version, aliases
from deepshade_trainer.service.config import Settings

log = logging.getLogger("deepshade.trainer")

TIMEOUT = 120.0  # seconds: a service loads and tries out what is new before it answers


class Refused(BundleError):
    """A service can't use a version; the alias is where it was."""


class Publisher:
    """The published models. One alias moves at a time; safe to use from several threads."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._lock = threading.Lock()

    def alias(self, effect: str, name: str) -> Alias:
        """That alias; raises BundleError where it has no versions."""
        alias = Alias(self._settings.published, effect, name)
        if alias.current is None:
            raise BundleError(
                f"{effect}/{name} has no versions here",
                fix="what is fine-tuned has them: see 'deepshade-client bundles'",
            )
        return alias

    def publish(self, bundle: Path, effect: str, name: str) -> tuple[Version, str]:
        """The version that a folder becomes, and what is to be said about it.

        What was shipped under that name becomes the first version, to go back to. A pinned alias
        stays. Raises Refused where a service can't use it, and BundleError.
        """
        alias = Alias(self._settings.published, effect, name)
        with self._lock:
            if not alias.numbers():
                for root in self._settings.bases:
                    if (root / effect / name / CONFIG).is_file():
                        first = alias.publish(root / effect / name)
                        alias.point(first.number)
                        break
            version = alias.publish(bundle)
            if alias.pinned is not None:
                return version, f"the alias stays at {alias.pinned}, where it is pinned"
            return version, self._move(alias, version.number)

    def pin(self, effect: str, name: str, number: int) -> str:
        """Move the alias to that version, to stay there."""
        alias = self.alias(effect, name)
        with self._lock:
            said = self._move(alias, number)
            alias.pin(number)
            return said

    def unpin(self, effect: str, name: str) -> None:
        """Let what is published next move the alias again."""
        self.alias(effect, name).pin(None)

    def roll_back(self, effect: str, name: str) -> str:
        """Move the alias to the version before its current one; a pin is lost."""
        alias = self.alias(effect, name)
        with self._lock:
            said = self._move(alias, alias.before())
            alias.pin(None)
            return said

    def listed(self) -> list[dict[str, Any]]:
        """All aliases with their versions."""
        return [describe(alias) for alias in aliases(self._settings.published)]

    def _move(self, alias: Alias, number: int) -> str:
        """Move the alias and tell the services; back again where one refuses."""
        before, label = alias.current, f"{alias.effect}/{alias.name}"
        alias.point(number)
        away: list[str] = []
        for service in self._settings.services:
            try:
                tell(service, self._settings.token, label)
            except Refused:
                if before is not None:
                    alias.point(before)
                    self._tell_again(label)
                raise
            except OSError as error:
                log.warning("%s can't be told of new bundles: %s", service, error)
                away.append(f"{service} wasn't told, and takes it when it starts again: {error}")
        return "; ".join(away)

    def _tell_again(self, label: str) -> None:
        for service in self._settings.services:
            try:
                tell(service, self._settings.token, label)
            except (Refused, OSError) as error:
                log.warning("%s can't be told of a change taken back: %s", service, error)


def tell(service: str, token: str | None, label: str) -> None:
    """Have a shading service look again. Raises Refused where it can't use the bundle `label`, and
    OSError where it isn't there or doesn't listen to us."""
    url = f"{service.rstrip('/')}/bundles/reload"
    request = urllib.request.Request(url, headers=carried(), method="POST")
    if token:
        request.add_header("Authorization", f"Bearer {token}")
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(request, timeout=TIMEOUT) as response:
            response.read()
    except urllib.error.HTTPError as error:
        said = _document(error.read)
        detail = str(said.get("detail", "it says no more"))[:500]
        if error.code != 409:
            raise OSError(f"HTTP {error.code}: {detail}") from error
        if label in said.get("refused", ()):
            raise Refused(f"the service at {service} refused it: {detail}") from error
        log.warning("%s refused another bundle: %s", service, detail)


def _document(read: Callable[[], bytes]) -> dict[str, Any]:
    try:
        document = json.loads(read())
    except (ValueError, OSError):
        return {}
    return document if isinstance(document, dict) else {}


def describe(alias: Alias) -> dict[str, Any]:
    """An alias and its versions as JSON values."""
    current = alias.current
    files = {} if current is None else alias.version(current).files
    return {
        "effect": alias.effect,
        "name": alias.name,
        "number": current,
        "versions": alias.numbers(),
        "pinned": alias.pinned,
        "sha256": files.get(MODEL),
    }
