"""What Prometheus reads of the trainer service: of the store and the jobs' files, when it asks."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from deepshade.machine import resident
from deepshade_trainer.service.store import RUNNING, STATES, Store

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
# of a running job's last event: the name there, ours, and what it is
_PROGRESS = (
    ("step", "step", "Steps, or views while rendering, that are done"),
    ("steps", "steps", "Steps, or views, in all"),
    ("loss", "loss", "Loss of the last steps"),
    ("dssim", "dssim", "DSSIM on views that judge the training, at the last validation"),
    ("rate", "steps_per_second", "Steps a second"),
    ("left", "left_seconds", "Seconds left of the steps"),
)


class Telemetry(Collector):
    """The figures of a store, and of the disks that `folders` are on.

    `last` gives a job's last event by its id.
    """

    def __init__(
        self,
        store: Store,
        last: Callable[[str], dict[str, Any] | None],
        folders: Collection[Path] = (),
    ) -> None:
        self._store, self._last, self._folders = store, last, folders
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def render(self) -> bytes:
        """All of them in Prometheus' text format. Asks the database: blocks."""
        return generate_latest(self._registry)

    def describe(self) -> Iterable[Metric]:
        """Nothing: registering shall not ask the database."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """The figures now; without those of jobs while the database is away."""
        memory = resident()
        yield GaugeMetricFamily(
            "deepshade_trainer_resident_bytes", "Physical memory of the service", memory
        )
        free = GaugeMetricFamily(
            "deepshade_trainer_disk_free_ratio", "Share of a folder's disk", labels=["folder"]
        )
        for folder in self._folders:
            with suppress(OSError):  # it was taken away
                usage = shutil.disk_usage(folder)
                free.add_metric([str(folder)], usage.free / usage.total)
        yield free
        try:
            counts, published = self._store.counts(), self._store.published()
            running, oldest = self._store.in_state(RUNNING), self._store.oldest()
        except SQLAlchemyError:
            running = None
        yield GaugeMetricFamily(
            "deepshade_trainer_database_up", "Whether the database answers", running is not None
        )
        if running is None:
            return
        jobs = GaugeMetricFamily("deepshade_trainer_jobs", "Jobs by state", labels=["state"])
        for state in STATES:
            jobs.add_metric([state], counts.get(state, 0))
        yield jobs
        yield CounterMetricFamily(
            "deepshade_trainer_published", "Jobs whose bundle was published", published
        )
        yield GaugeMetricFamily(
            "deepshade_trainer_oldest_seconds",
            "How long the first in the queue waits",
            0.0 if oldest is None else max(0.0, time.time() - oldest),
        )
        events = [(job, _flat(self._last(job.id) or {})) for job in running]
        for key, name, text in _PROGRESS:
            family = GaugeMetricFamily(
                f"deepshade_trainer_job_{name}", text, labels=["job", "effect", "phase"]
            )
            for job, event in events:
                if isinstance(value := event.get(key), int | float):
                    family.add_metric([job.id, job.effect, str(event.get("phase", ""))], value)
            yield family


def _flat(event: dict[str, Any]) -> dict[str, Any]:
    """An event with its validation's figures beside the others."""
    return event | (event.get("validation") or {})
