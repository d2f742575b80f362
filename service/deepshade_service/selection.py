"""Which bundle on which backend a request gets: by name, by error, by time, or by default."""

from __future__ import annotations

import math
from dataclasses import dataclass

from deepshade.bundles import Bundle
from deepshade.engines import Backend, available
from deepshade.errors import EngineError
from deepshade_service.models import Models
from deepshade_service.parameters import ShadeParameters
from deepshade_service.problems import Problem

DEFAULT = "balanced"


@dataclass(frozen=True, slots=True)
class Selection:
    """A bundle on a backend, and why, in words."""

    bundle: Bundle
    backend: Backend
    reason: str


# A bundle, and what it runs on here.
Candidate = tuple[Bundle, Backend]


def allowed(models: Models, effect: str, asked: ShadeParameters) -> list[Candidate]:
    """Those that a request may get, whatever the picture; the least error first.

    Raises Problem 404 (no such effect or bundle), 422 (no such backend here, contradicting
    parameters) and 503 (not ready).
    """
    if asked.quality is not None and asked.bundle not in (None, asked.quality):
        raise Problem(
            422,
            "bad-parameter",
            f"?bundle={str(asked.bundle)[:100]} and ?quality={asked.quality}"
            " ask for different bundles",
            fix="give one of the two",
        )
    bundles = models.find(effect, asked.quality or asked.bundle)
    candidates: list[Candidate] = []
    why = ""
    for bundle in bundles:
        try:
            candidates.append((bundle, models.backend(bundle, asked.engine, asked.precision)))
        except EngineError as error:
            why = str(error)
    if not candidates:
        raise Problem(
            422,
            "no-backend",
            why,
            fix="choose one of `available`, or leave out ?engine= and ?precision=",
            available=[str(one) for one in available()],
        )
    return candidates


async def select(
    models: Models,
    candidates: list[Candidate],
    asked: ShadeParameters,
    megapixels: dict[str, float],
) -> Selection:
    """The one of `candidates` that a request gets, for a picture of which so much is computed.

    `megapixels` are by the bundle's name. Raises Problem 422 when an error or a time can't be
    kept, and 500 when a bundle that has to be timed can't be loaded.
    """
    if asked.budget_ms is not None:
        return await _within_time(models, candidates, asked.budget_ms, asked.max_error, megapixels)
    if asked.max_error is not None:
        return _within_error(candidates, asked.max_error)
    default = [candidate for candidate in candidates if candidate[0].name == DEFAULT]
    names = ("quality", "bundle", "engine", "precision")
    pins = ", ".join(f"{name} {value}" for name in names if (value := getattr(asked, name)))
    reason = f"asked for: {pins}" if pins else "the default"
    return Selection(*(default or candidates)[0], reason)


async def _within_time(
    models: Models,
    candidates: list[Candidate],
    budget: float,
    max_error: float | None,
    megapixels: dict[str, float],
) -> Selection:
    """The most accurate bundle whose network is predicted to keep the time."""
    times = [
        await models.ms_per_megapixel(*candidate) * megapixels[candidate[0].name]
        for candidate in candidates
    ]
    fitting = [index for index, ms in enumerate(times) if ms <= budget]
    if not fitting:
        best, (quickest, backend) = min(zip(times, candidates, strict=True), key=lambda e: e[0])
        raise Problem(
            422,
            "budget-too-small",
            f"no bundle shades this picture in {budget:g} ms: the quickest, {quickest.name} on"
            f" {backend}, needs {best:.3g} ms, {best - budget:.3g} ms more",
            fix=f"ask for at least ?budget_ms={_up_to_three(best):g}, or send a smaller picture",
            asked=budget,
            best=best,
            short_by=best - budget,
            bundle=quickest.name,
        )
    bundle, backend = candidates[fitting[0]]
    if max_error is not None and (bundle.dssim is None or bundle.dssim > max_error):
        raise _too_exact(max_error, bundle, f" within {budget:g} ms")
    predicted = f"{times[fitting[0]]:.3g} ms predicted"
    return Selection(bundle, backend, f"the most accurate within {budget:g} ms: {predicted}")


def _within_error(candidates: list[Candidate], most: float) -> Selection:
    """The bundle with the largest published error that is small enough: it is the fastest."""
    known = [(b.dssim, b, backend) for b, backend in candidates if b.dssim is not None]
    if not known:
        raise Problem(
            422,
            "no-measured-error",
            "no bundle here says how large its error is",
            fix="leave out ?max_error=, or export the bundles with their metrics",
        )
    good = [entry for entry in known if entry[0] <= most]
    if not good:
        raise _too_exact(most, known[0][1])
    error, bundle, backend = good[-1]
    reason = f"the fastest with an error of at most {most:g}: {error:.4g}"
    return Selection(bundle, backend, reason)


def _too_exact(most: float, best: Bundle, when: str = "") -> Problem:
    detail, fix, more = f"{best.name}, whose error isn't known", "", {}
    if best.dssim is not None:
        short = best.dssim - most
        detail = f"{best.name} with {best.dssim:.4g}, {short:.3g} more"
        fix = f"ask for at least ?max_error={_up_to_three(best.dssim):g}"
        more = {"best": best.dssim, "short_by": short}
    return Problem(
        422,
        "error-too-small",
        f"no bundle reaches a DSSIM of {most:g}{when}: the best is {detail}",
        fix=fix,
        headers=None,
        asked=most,
        bundle=best.name,
        **more,
    )


def _up_to_three(value: float) -> float:
    """Rounded up, so that asking for it succeeds, to three digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 2) if value > 0 else 1.0
    return math.ceil(value / step) * step
