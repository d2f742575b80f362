"""Which bundle on which backend a request gets: by name, by error, by time, or by default."""

from __future__ import annotations

import math
from dataclasses import dataclass

from deepshade.bundles import Bundle
from deepshade.effects import EFFECTS
from deepshade.engines import Backend
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


def allowed(models: Models, effect: str, asked: ShadeParameters) -> tuple[list[Bundle], Backend]:
    """(the bundles that a request may get, by error; what it runs on), whatever the picture.

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
    asked.check(EFFECTS[effect])
    return bundles, models.backend(asked.engine, asked.precision)


async def select(
    models: Models,
    bundles: list[Bundle],
    backend: Backend,
    asked: ShadeParameters,
    megapixels: dict[str, float],
) -> Selection:
    """The one of `bundles` that a request gets, for a picture of which so much is computed.

    `megapixels` are by the bundle's name. Raises Problem 422 when an error or a time can't be
    kept, and 500 when a bundle that has to be timed can't be loaded.
    """
    if asked.budget_ms is not None:
        return await _within_time(models, bundles, backend, asked, megapixels)
    if asked.max_error is not None:
        return _within_error(bundles, backend, asked.max_error)
    pins = [
        f"{n} {v}" for n in ("quality", "bundle", "engine", "precision") if (v := getattr(asked, n))
    ]
    default = [bundle for bundle in bundles if bundle.name == DEFAULT]
    reason = f"asked for: {', '.join(pins)}" if pins else "the default"
    return Selection((default or bundles)[0], backend, reason)


async def _within_time(
    models: Models,
    bundles: list[Bundle],
    backend: Backend,
    asked: ShadeParameters,
    megapixels: dict[str, float],
) -> Selection:
    """The most accurate bundle whose network is predicted to keep the time."""
    budget, most = asked.budget_ms, asked.max_error
    assert budget is not None
    times = {
        bundle.name: await models.ms_per_megapixel(bundle, backend) * megapixels[bundle.name]
        for bundle in bundles
    }
    fitting = [bundle for bundle in bundles if times[bundle.name] <= budget]
    if not fitting:
        quickest = min(times, key=lambda name: times[name])
        best = times[quickest]
        raise Problem(
            422,
            "budget-too-small",
            f"no bundle shades this picture in {budget:g} ms: the quickest, {quickest} on"
            f" {backend}, needs {best:.3g} ms for {megapixels[quickest]:.3g} megapixels,"
            f" {best - budget:.3g} ms more",
            fix=f"ask for at least ?budget_ms={_up_to_three(best):g}, or send a smaller picture",
            asked=budget,
            best=best,
            short_by=best - budget,
            bundle=quickest,
        )
    chosen = fitting[0]
    if most is not None and (chosen.dssim is None or chosen.dssim > most):
        raise _too_exact(most, chosen, f" within {budget:g} ms")
    predicted = times[chosen.name]
    reason = f"the most accurate within {budget:g} ms: {predicted:.3g} ms predicted"
    return Selection(chosen, backend, reason)


def _within_error(bundles: list[Bundle], backend: Backend, most: float) -> Selection:
    """The bundle with the largest published error that is small enough: it is the fastest."""
    known = [(bundle.dssim, bundle) for bundle in bundles if bundle.dssim is not None]
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
    error, chosen = good[-1]
    reason = f"the fastest with an error of at most {most:g}: {error:.4g}"
    return Selection(chosen, backend, reason)


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
