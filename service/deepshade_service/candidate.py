"""A bundle on a backend: what is known of it, and which of them is the bundle's default."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from deepshade.bundles import Bundle
from deepshade.engines import Backend, usable
from deepshade_service.calibration import Calibration
from deepshade_service.measurement import Measurement, published

# What a backend may add to a bundle's error and still be chosen when nobody asked.
MOST_ADDED = 0.02
_TYPICAL = 768 * 512


@dataclass(frozen=True, slots=True)
class Candidate:
    """A bundle on a backend: what a request may get.

    `dssim` is the error to expect on real views and `added` the share that the backend adds to
    the bundle's own; None where nothing was measured. `default` marks what the bundle runs on
    when a request says nothing of it, which is the fastest that adds at most `MOST_ADDED`.
    """

    bundle: Bundle
    backend: Backend
    dssim: float | None = None
    added: float | None = None
    fixed_ms: float | None = None
    ms_per_megapixel: float | None = None
    calibrated: bool = False
    default: bool = False

    def ms(self, pixels: int) -> float | None:
        """Milliseconds of the network for so many computed pixels; None if never measured."""
        if self.fixed_ms is None or self.ms_per_megapixel is None:
            return None
        return self.fixed_ms + self.ms_per_megapixel * pixels / 1e6


def candidates_of(bundle: Bundle, calibration: Calibration | None) -> list[Candidate]:
    """A bundle on every backend that it can run on here, its default first."""
    own = published(bundle)
    known: dict[Backend, Measurement] = {}
    backends = usable(bundle)
    if calibration is not None:
        known = {found.backend: found for found in calibration.all(bundle)}
        backends = [b for b in backends if not calibration.failed(bundle, b)]
    # What isn't measured yet could be anything: 32 bits until all of it is.
    whole = bool(backends) and all(backend in known for backend in backends)
    chosen = (fastest(known.values()) if whole else None) or next(iter(backends), None)
    candidates = []
    for backend in backends:
        found = known.get(backend)
        default = backend == chosen
        if found is None:
            dssim = own if backend.precision == "fp32" else None
            candidates.append(Candidate(bundle, backend, dssim, default=default))
            continue
        dssim = found.dssim if found.dssim is not None else own
        measured = (found.added, found.fixed_ms, found.ms_per_megapixel)
        candidates.append(Candidate(bundle, backend, dssim, *measured, True, default))
    return sorted(candidates, key=lambda one: not one.default)


def fastest(known: Iterable[Measurement]) -> Backend | None:
    """The fastest of the measured backends that adds at most `MOST_ADDED`; None if none does.

    16 and 8 bits only count where their error is known; 32 bits are taken for exact.
    """
    good = [
        found
        for found in known
        if (0.0 if found.added is None and found.backend.precision == "fp32" else found.added)
        is not None
        and (found.added or 0.0) <= MOST_ADDED
    ]
    return min(good, key=lambda found: found.ms(_TYPICAL)).backend if good else None


def speed(candidate: Candidate) -> float:
    """Milliseconds of the network for a typical picture; infinity if never measured."""
    ms = candidate.ms(_TYPICAL)
    return float("inf") if ms is None else ms
