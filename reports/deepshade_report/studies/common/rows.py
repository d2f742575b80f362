"""A study's measured points, kept in one JSON file that is never half written."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from deepshade.files import replacing

FORMAT, VERSION = "deepshade-study", 1

Point = dict[str, Any]
Row = dict[str, Any]  # {"point": …, "seconds": …, and the figures}


class Rows:
    """The rows in `path`, in the order in which they were measured.

    What is there is kept if `resume` is asked for and it was measured with the same settings, which
    `key` stands for; else the file begins anew with the first row. `about` is written beside them.
    """

    def __init__(self, path: Path, key: str, about: Mapping[str, Any], *, resume: bool) -> None:
        self.path, self.key, self.about = path, key, dict(about)
        self.rows: list[Row] = _kept(path, key) if resume else []

    def find(self, point: Point) -> Row | None:
        """The row of a point, None where it isn't measured."""
        return next((row for row in self.rows if row["point"] == point), None)

    def add(self, row: Row) -> Row:
        """Keep a row, in the file too; returns it as the file gives it back, NaN as None."""
        row = dict(json.loads(json.dumps(row), parse_constant=lambda _: None))
        self.rows.append(row)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(self.path) as temporary:
            temporary.write_text(json.dumps(self.document(), indent=1, allow_nan=False), "utf-8")
        return row

    def document(self) -> dict[str, Any]:
        """The file as JSON values."""
        head = {"format": FORMAT, "version": VERSION, "key": self.key}
        return {**head, **self.about, "rows": self.rows}


def _kept(path: Path, key: str) -> list[Row]:
    try:
        found = json.loads(path.read_text("utf-8"))
        return list(found["rows"]) if found["key"] == key else []
    except (OSError, ValueError, KeyError, TypeError):
        return []


def by(rows: Sequence[Row], key: str, figure: Callable[[Row], float]) -> dict[str, float]:
    """Means of a figure by one entry of the rows' points, as over seeds."""
    found: dict[str, list[float]] = {}
    for row in rows:
        found.setdefault(str(row["point"][key]), []).append(figure(row))
    return {name: fmean(each) for name, each in found.items()}
