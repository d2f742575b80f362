"""Which bundle on which backend a request gets: by name, by error, by time, or by default."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem

if TYPE_CHECKING:
    from deepshade_service.candidate import Candidate
    from deepshade_service.models import Models

DEFAULT = "balanced"

# How many pixels a candidate would compute of this picture.
Pixels = Callable[["Candidate"], int]


@dataclass(frozen=True, slots=True)
class Choice:
    """What was chosen, and why, in words."""

    candidate: Candidate
    reason: str


@dataclass(frozen=True, slots=True)
class Choices:
    """All that the request leaves open: `pool` holds what it allows, `plain` its default.

    `pool` is in the order of `Models.candidates`: bundles by error, least first.
    """

    pool: tuple[Candidate, ...]
    plain: Candidate
    asked: ShadeParameters
    calibrating: bool = False

    @classmethod
    def of(cls, models: Models, effect: str, asked: ShadeParameters) -> Choices:
        """Those that a request may get; refuses what no picture could change.

        Raises Problem 404 (no such effect or bundle), 422 (no such backend here, contradicting
        parameters) and 503 (not ready).
        """
        name = _bundle_name(asked)
        if name is None and asked.max_error is None and asked.budget_ms is None:
            names = {candidate.bundle.name for candidate in models.candidates(effect)}
            name = DEFAULT if DEFAULT in names else None
        plain = models.candidate(effect, name, asked.engine, asked.precision)
        pool = tuple(
            candidate
            for candidate in models.candidates(effect)
            if name in (None, candidate.bundle.name)
            and asked.engine in (None, candidate.backend.engine)
            and asked.precision in (None, candidate.backend.precision)
        )
        return cls(pool, plain, asked, models.calibrating)

    @property
    def open(self) -> bool:
        """Whether the picture's content can still change the choice."""
        return self.asked.budget_ms is not None

    def first(self, pixels: int) -> Choice:
        """The choice for a picture of which `pixels` will be computed at most.

        Where not even the quickest candidate fits the budget it is that one all the same:
        background may spare enough. `final` decides. Raises Problem 422, 503.
        """
        if self.open:
            return self._fitting(lambda _: pixels) or Choice(
                self._quickest(pixels), "the quickest there is"
            )
        if self.asked.max_error is not None:
            return self._within_error(pixels)
        return Choice(self.plain, self._plainly())

    def final(self, pixels: Pixels) -> Choice:
        """The choice by budget, now that the pixels to compute are known for each candidate.

        Raises Problem 422 when the budget can't be met, or not within the error asked for.
        """
        chosen = self._fitting(pixels)
        if chosen is not None:
            return chosen
        budget = self.asked.budget_ms
        assert budget is not None
        quickest = min(self.pool, key=lambda candidate: _ms(candidate, pixels(candidate)))
        best = _ms(quickest, pixels(quickest))
        raise Problem(
            422,
            "budget-too-small",
            f"no bundle shades this picture in {budget:g} ms: the quickest, {_name(quickest)},"
            f" needs {best:.3g} ms for the {pixels(quickest):,} pixels to compute,"
            f" {best - budget:.3g} ms more",
            fix=f"ask for at least ?budget_ms={_up_to_three(best):g}, or send a smaller picture",
            asked=budget,
            best=round(best, 4),
            short_by=round(best - budget, 4),
            candidate=_name(quickest),
        )

    def _fitting(self, pixels: Pixels) -> Choice | None:
        """The most accurate candidate that keeps the budget; None if none does."""
        budget, most = self.asked.budget_ms, self.asked.max_error
        assert budget is not None
        self._check_calibrated()
        fitting = [
            (_error(candidate, math.inf), ms, n, candidate)
            for n, candidate in enumerate(self.pool)
            if (ms := candidate.ms(pixels(candidate))) is not None and ms <= budget
        ]
        if not fitting:
            return None
        error, ms, _, best = min(fitting, key=lambda entry: entry[:3])
        if most is not None and error > most:
            raise _too_exact(most, error, best, f" within {budget:g} ms")
        return Choice(best, f"the most accurate within {budget:g} ms: {ms:.3g} ms predicted")

    def _within_error(self, pixels: int) -> Choice:
        """The fastest candidate whose measured error is small enough."""
        most = self.asked.max_error
        assert most is not None
        measured = [(c, error) for c in self.pool if (error := _measured(c)) is not None]
        if not measured:
            raise Problem(
                422,
                "no-measured-error",
                "no bundle here says how large its error is",
                fix="leave out ?max_error=, or export the bundles with their metrics",
            )
        good = [entry for entry in measured if entry[1] <= most]
        if not good:
            best, least = min(measured, key=lambda entry: entry[1])
            raise _too_exact(most, least, best)
        # what isn't timed yet comes after what is; among those a larger error means a smaller net
        fastest, error = min(
            good, key=lambda entry: (_ms(entry[0], pixels), not entry[0].default, -entry[1])
        )
        return Choice(fastest, f"the fastest with an error of at most {most:g}: {error:.4g}")

    def _quickest(self, pixels: int) -> Candidate:
        return min(self.pool, key=lambda candidate: _ms(candidate, pixels))

    def _check_calibrated(self) -> None:
        if any(candidate.fixed_ms is not None for candidate in self.pool):
            return
        if self.calibrating:
            raise Problem(
                503,
                "not-calibrated",
                "this machine's calibration isn't done yet, so no time can be predicted",
                fix="try again in a few seconds, or choose with ?quality=",
                headers={"Retry-After": "5"},
            )
        raise Problem(
            422,
            "not-calibrated",
            "this machine isn't calibrated, so no time can be predicted",
            fix="run deepshade bench --calibrate, or choose with ?quality=",
        )

    def _plainly(self) -> str:
        asked = self.asked
        pins = [
            f"{name} {value}"
            for name, value in (
                ("bundle", _bundle_name(asked)),
                ("engine", asked.engine),
                ("precision", asked.precision),
            )
            if value is not None
        ]
        if asked.engine and asked.precision:
            backend = ""
        elif not self.plain.calibrated:
            backend = "; not calibrated, so in fp32"
        else:
            backend = "; the fastest that adds little error" if self.plain.default else ""
        return (f"asked for: {', '.join(pins)}" if pins else "the default") + backend


def _bundle_name(asked: ShadeParameters) -> str | None:
    """The bundle that `bundle` or `quality` names. Raises Problem 422 if they differ."""
    if asked.quality is not None and asked.bundle not in (None, asked.quality):
        raise Problem(
            422,
            "bad-parameter",
            f"?bundle={asked.bundle[:100] if asked.bundle else ''} and ?quality={asked.quality}"
            " ask for different bundles",
            fix="give one of the two",
        )
    return asked.quality or asked.bundle


def _too_exact(most: float, error: float, best: Candidate, when: str = "") -> Problem:
    return Problem(
        422,
        "error-too-small",
        f"no bundle reaches a DSSIM of {most:g}{when}: the best is {_name(best)} with"
        f" {error:.4g}, {error - most:.3g} more",
        fix=f"ask for at least ?max_error={_up_to_three(error):g}",
        asked=most,
        best=error,
        short_by=error - most,
        candidate=_name(best),
    )


def _name(candidate: Candidate) -> str:
    return f"{candidate.bundle.name} on {candidate.backend}"


def _measured(candidate: Candidate) -> float | None:
    """Its error, where that has been measured: a precision's cost isn't known before."""
    known = candidate.added is not None or candidate.backend.precision == "fp32"
    return candidate.dssim if known else None


def _error(candidate: Candidate, unknown: float) -> float:
    error = _measured(candidate)
    return unknown if error is None else error


def _ms(candidate: Candidate, pixels: int) -> float:
    ms = candidate.ms(pixels)
    return float("inf") if ms is None else ms


def _up_to_three(value: float) -> float:
    """Rounded up, so that asking for it succeeds, to three digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2) if value > 0 else 1.0
    return math.ceil(value / step) * step


def considered(pool: tuple[Candidate, ...], pixels: Pixels) -> list[dict[str, Any]]:
    """What each candidate would have cost and given, for the plan."""
    return [
        {
            "bundle": candidate.bundle.name,
            "engine": candidate.backend.engine,
            "precision": candidate.backend.precision,
            "dssim": rounded(_measured(candidate)),
            "predicted_ms": rounded(candidate.ms(pixels(candidate))),
        }
        for candidate in pool
    ]


def rounded(value: float | None) -> float | None:
    """To four digits, for people who read the plan."""
    return None if value is None else float(f"{value:.4g}")
