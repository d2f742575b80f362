"""What a live frame asks for: effects and settings, as a request's path and query do."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from deepshade.effects import Effect
from deepshade_service import problems
from deepshade_service.models import Models, find_effects
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem
from deepshade_service.selection import Candidate, allowed

# of files, not of frames
_NOT_LIVE = ("upload", "format", "compression", "half", "append", "layer", "multiply", "explain")


@dataclass(frozen=True, slots=True)
class Asking:
    """Effects with the bundles that may shade each, and checked settings."""

    names: str
    effects: tuple[Effect, ...]
    parameters: ShadeParameters
    candidates: list[list[Candidate]]


class Reader:
    """Reads what frames ask for; what the one before asked for is kept, as most ask the same."""

    def __init__(self, models: Models) -> None:
        self._models = models
        self._text = ""
        self._last: Asking | None = None
        self._said: dict[str, Any] = {"effects": "ao", "settings": {}}

    def read(self, about: Mapping[str, Any]) -> Asking:
        """What "effects" and "settings" of a hello or a frame say; what is left out is as before.

        Raises Problem 404 and 422, 503 while bundles load, and ConfigError.
        """
        said = self._said | {key: about[key] for key in ("effects", "settings") if key in about}
        text = json.dumps(said, sort_keys=True)
        if self._last is None or text != self._text:
            self._last, self._text = self._asking(said), text
            self._said = said
        return self._last

    def _asking(self, said: Mapping[str, Any]) -> Asking:
        names, settings = said["effects"], said["settings"]
        if not isinstance(names, str) or not isinstance(settings, dict):
            raise Problem(
                422,
                "bad-parameter",
                '"effects" must be a text such as "ao,gi", and "settings" an object',
            )
        for name in _NOT_LIVE:
            if name in settings:
                raise Problem(
                    422,
                    "bad-parameter",
                    f"{name}: live frames have no such setting",
                    fix=f'leave "{name}" out of "settings"',
                )
        effects = find_effects(names)
        try:
            parameters = ShadeParameters.model_validate(settings)
        except ValidationError as error:
            raise problems.invalid(error.errors(), ShadeParameters.model_fields) from None
        if len(parameters.views) > 1:
            raise Problem(
                422,
                "bad-parameter",
                "view: a live frame is of one view",
                fix="name one, or stream each in a session of its own",
            )
        candidates = [allowed(self._models, effect.name, parameters) for effect in effects]
        parameters.check(effects)
        return Asking(names, tuple(effects), parameters, candidates)
