"""One run over all cases: what is measured is kept as it comes, so that it can go on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from deepshade.bundles import Bundle, bundle_folders
from deepshade.engines import REFERENCE, Backend, usable
from deepshade.errors import ConfigError
from deepshade.files import shipped
from deepshade_report.context import machine
from deepshade_report.hardcases import learning, table
from deepshade_report.hardcases.cases import CASES, LARGE, Case
from deepshade_report.hardcases.exact import ROUNDED
from deepshade_report.hardcases.measure import Bench, Row

DEFAULT = "balanced"
# Not of pictures that are shaded: see `learning`.
LEARNING = Case(learning.CASE, lambda effect, easy: iter(()))
_SHAPE, _QUICK_SHAPE = (128, 192), (64, 96)


def chosen_cases(texts: Collection[str] = (), *, large: bool = False) -> list[Case]:
    """Those whose names hold one of the texts; without, all. Raises ConfigError where none does."""
    every = [*CASES, *([LARGE] if large else []), LEARNING]
    found = [case for case in every if not texts or any(text in case.name for text in texts)]
    if not found:
        names = [case.name for case in every]
        raise ConfigError(
            min(texts), names, detail=f"no case is called '{min(texts)}': {', '.join(names)}"
        )
    return found


class Session:
    """Cases by the bundles of a folder; rows go to `file` as JSON lines, pictures beside it."""

    def __init__(
        self, models: Path, out: Path, cases: Sequence[Case], *, quick: bool, threads: int
    ) -> None:
        self.models, self.out, self.cases = models, out, cases
        self.quick, self.threads = quick, threads
        self.file = out / "rows.jsonl"

    def measure(
        self, effects: Collection[str], bundles: Collection[str], *, resume: bool
    ) -> Iterator[tuple[int, int, list[Row]]]:
        """(cases done, of how many, the rows of the latest), bundle by bundle.

        With `resume` what is in the file counts, if bundle, samples, size and machine are the same.
        """
        chosen = [Bundle.load(folder) for folder in self._folders(effects, bundles)]
        known = self._known() if resume else {}
        total = len(chosen) * len(self.cases)
        self.out.mkdir(parents=True, exist_ok=True)
        if not resume:
            self.file.unlink(missing_ok=True)
        elif self.file.exists() and not self.file.read_bytes().endswith(b"\n"):
            with self.file.open("a", encoding="utf-8") as file:
                file.write("\n")  # it was killed while it wrote
        for number, bundle in enumerate(chosen):
            stamp = self._stamp(bundle)
            bench: Bench | None = None
            for index, case in enumerate(self.cases):
                done = number * len(self.cases) + index + 1
                found = known.get((stamp, bundle.effect, bundle.name, case.name))
                if found is None:
                    if bench is None:
                        bench = Bench(bundle, self._backends(bundle), self._shape, self.threads)
                    found = self._rows(bench, case)
                    with self.file.open("a", encoding="utf-8") as file:
                        line: dict[str, Any] = {
                            "stamp": stamp,
                            "effect": bundle.effect,
                            "bundle": bundle.name,
                        }
                        line |= {"case": case.name, "rows": [row.as_json() for row in found]}
                        file.write(json.dumps(line) + "\n")
                yield done, total, found

    @property
    def _shape(self) -> tuple[int, int]:
        return _QUICK_SHAPE if self.quick else _SHAPE

    def _folders(self, effects: Collection[str], bundles: Collection[str]) -> list[Path]:
        wanted = set(bundles) or ({DEFAULT} if self.quick else set())
        found = [
            path
            for path in bundle_folders(self.models)
            if (not effects or path.parent.name in effects) and (not wanted or path.name in wanted)
        ]
        if not found:
            detail = f"{self.models} holds no such bundle"
            raise ConfigError("models", detail=f"{detail}: choose another --effect or --bundle")
        return found

    def _backends(self, bundle: Bundle) -> list[Backend]:
        if self.quick:
            return [REFERENCE]
        native = usable(bundle)
        if bundle.exact or any(backend.precision == ROUNDED.precision for backend in native):
            return native
        return [*native, ROUNDED]

    def _stamp(self, bundle: Bundle) -> str:
        """What rows hold for."""
        samples = [path.stat().st_size for path in sorted(shipped("samples").glob("*.exr"))]
        facts = bundle.sha256, samples, self._shape, machine(), self.quick
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:16]

    def _known(self) -> dict[tuple[str, str, str, str], list[Row]]:
        if not self.file.exists():
            return {}
        found = {}
        for text in self.file.read_text("utf-8").splitlines():
            try:
                line = json.loads(text)
                key = line["stamp"], line["effect"], line["bundle"], line["case"]
                found[key] = [Row(**row) for row in line["rows"]]
            except (ValueError, KeyError, TypeError):
                continue  # the last one, cut off when it was stopped, or of another version
        return found

    def _rows(self, bench: Bench, case: Case) -> list[Row]:
        if case is LEARNING:
            return list(learning.rows(bench.bundle, bench.easy))
        rows = []
        for row, picture, answer in bench.rows(case):
            rows.append(row)
            truth = picture.truth if picture.truth is not None else bench.truth(picture)
            if not row.passed and answer is not None and truth is not None:
                table.draw(self.out / "failed", row, answer, truth)
        return rows
