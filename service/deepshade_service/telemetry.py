"""What the service counts (Prometheus), and the clock behind Server-Timing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from deepshade.machine import resident
from deepshade.tracing import span

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60)


class Stopwatch:
    """Milliseconds of named stages, in the order in which they ran."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}

    @contextmanager
    def time(self, stage: str) -> Iterator[None]:
        """Add the block's duration to `stage`."""
        start = time.perf_counter()
        try:
            with span(stage):
                yield
        finally:
            took = 1e3 * (time.perf_counter() - start)
            self.milliseconds[stage] = self.milliseconds.get(stage, 0.0) + took


def server_timing(milliseconds: Mapping[str, float]) -> str:
    """Times of stages as the value of a Server-Timing header."""
    return ", ".join(f"{name};dur={ms:.2f}" for name, ms in milliseconds.items())


class Telemetry:
    """One service's counters. Each service has its own registry, so that tests can run several."""

    def __init__(self, *, queued: Callable[[], float], held: Callable[[], float]) -> None:
        self._registry = CollectorRegistry()

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(f"deepshade_{name}", text, labels, registry=self._registry)

        self._requests = counter(
            "requests", "Requests answered, by route and status", "route", "status"
        )
        self._pixels = counter("pixels", "Pixels shaded", "effect")
        self._computed = counter(
            "computed_pixels", "Pixels that networks computed, overlaps included", "effect"
        )
        self._nonfinite = counter(
            "nonfinite_pixels", "Pixels with a NaN or infinity, treated as background", "effect"
        )
        self._stages = Histogram(
            "deepshade_stage_seconds",
            "Time of each stage of a shaded picture",
            ["effect", "stage"],
            buckets=_SECONDS,
            registry=self._registry,
        )
        for name, text, read in (
            ("deepshade_jobs", "Pictures being shaded or waiting", queued),
            ("deepshade_upload_bytes", "Bytes of bodies held in memory", held),
            ("deepshade_resident_bytes", "Physical memory of the process", resident),
        ):
            Gauge(name, text, registry=self._registry).set_function(read)

    def answered(self, route: str, status: int) -> None:
        """Count a response."""
        self._requests.labels(route, str(status)).inc()

    def shaded(
        self,
        effect: str,
        milliseconds: Mapping[str, float],
        pixels: int,
        computed: int,
        nonfinite: int,
    ) -> None:
        """Count an effect of a picture; `milliseconds` are by stage."""
        for stage, ms in milliseconds.items():
            self._stages.labels(effect, stage).observe(ms / 1e3)
        self._pixels.labels(effect).inc(pixels)
        self._computed.labels(effect).inc(computed)
        self._nonfinite.labels(effect).inc(nonfinite)

    def render(self) -> bytes:
        """All counters in Prometheus' text format."""
        return generate_latest(self._registry)
