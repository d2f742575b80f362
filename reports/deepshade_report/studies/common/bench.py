"""Where a study works: its folders, scale and threads, and what studies look at in common."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from sys import stderr
from types import ModuleType
from typing import Any

from deepshade.bundles import Bundle, bundle_folders
from deepshade.engines import REFERENCE, load_engine
from deepshade_report.context import Context, machine
from deepshade_report.method import Method, Network
from deepshade_report.studies.common.rows import Row, Rows
from deepshade_report.studies.common.scale import Scale
from deepshade_report.view import View, load_views


@dataclass
class Bench:
    """One study's place.

    `out` holds its rows, plot and runs, `data` the rendered sets. `views_from` is a data set of
    held-out views for bundles that ship, in place of rendered ones. Of bundles in several folders
    `models` the first counts. `advance(done, total, doing)` hears of progress in points.
    """

    name: str
    out: Path
    data: Path
    models: Sequence[Path]
    scale: Scale
    threads: int = 1
    views_from: Path | None = None
    resume: bool = False
    advance: Callable[[int, int, str], None] = lambda done, total, doing: None
    cache: dict[str, Any] = field(default_factory=dict, init=False)
    _at: tuple[int, int] = field(default=(0, 1), init=False)

    def run(self, study: ModuleType) -> tuple[list[Row], Path]:
        """Measure what isn't measured, point by point; the rows and the plot's path.

        Raises what the study does; the rows that are done stay.
        """
        about = {
            "study": self.name,
            "title": study.TITLE,
            "figure": study.FIGURE,
            "scale": asdict(self.scale),
            "machine": machine(),
        }
        kept = Rows(self.out / f"{self.name}.json", self.key(), about, resume=self.resume)
        if not kept.rows:  # runs of other settings, or that shall not go on
            if not self.resume or not self._same_runs():
                shutil.rmtree(self.out / self.name, ignore_errors=True)
            self._stamp.parent.mkdir(parents=True, exist_ok=True)
            self._stamp.write_text(self.key(), "utf-8")
        points = study.points(self)
        for number, point in enumerate(points):
            self._at = number, len(points)
            if kept.find(point) is None:
                self.doing(", ".join(f"{key} {value}" for key, value in point.items()))
                began = time.perf_counter()
                figures = study.measure(self, point)
                seconds = round(time.perf_counter() - began, 1)
                kept.add({"point": point, "seconds": seconds, **figures})
        self.advance(len(points), len(points), "")
        rows = [row for point in points if (row := kept.find(point)) is not None]
        picture = self.out / f"{self.name}.png"
        picture.write_bytes(study.draw(self, rows))
        return rows, picture

    def doing(self, text: str) -> None:
        """What is being done for the point at hand."""
        self.advance(*self._at, text)

    def key(self) -> str:
        """Stamps rows: they are kept for the same scale, bundles, views and machine."""
        hashes = [Bundle.load(path).sha256 for path in bundle_folders(*self.models)]
        facts = asdict(self.scale), hashes, str(self.views_from), machine(), self.threads
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]

    def runs(self, name: str) -> Path:
        """The folder of a training run."""
        return self.out / self.name / name

    @property
    def _stamp(self) -> Path:
        return self.out / self.name / "key"

    def _same_runs(self) -> bool:
        return self._stamp.is_file() and self._stamp.read_text("utf-8") == self.key()

    def set(self, name: str) -> Path:
        """The folder of a data set (`sets.specs`), which is rendered where it isn't complete."""
        from deepshade_report.studies.common.sets import specs
        from deepshade_workers.datagen import generate

        spec = specs(self.scale, self.data)[name]
        folder = self.data / f"{name}-{spec.views}x{spec.size}"
        with redirect_stdout(stderr):  # where Ray tells of workers that died
            for done, total in generate(spec, folder):
                self.doing(f"rendering {name}: {done} of {total} views")
        return folder.resolve()

    @cached_property
    def context(self) -> Context:
        """The report's view of this machine: bundles and held-out views of ambient occlusion."""
        found = self.views_from or self.set("wide")
        return Context(self.models, found, self.out, threads=self.threads)

    @cached_property
    def views(self) -> list[View]:
        """The held-out views that bundles are shown. Raises DataError without."""
        return load_views(self.context.data, "ao", self.scale.wide_views)

    @cached_property
    def methods(self) -> dict[str, Method]:
        """The bundles that ship (ONNX Runtime, fp32), and GTAO and HBAO at their best settings."""
        import drjit as dr

        from deepshade_report.baselines.ao.gtao import methods as gtao
        from deepshade_report.baselines.ao.hbao import methods as hbao

        dr.set_thread_count(self.threads)
        found: dict[str, Method] = {}
        for bundle in self.context.served:
            engine = load_engine(bundle, REFERENCE, threads=self.threads)
            found[bundle.name] = Network(bundle, engine)
        return {**found, "GTAO": gtao(False)[-1], "HBAO": hbao(False)[-1]}
