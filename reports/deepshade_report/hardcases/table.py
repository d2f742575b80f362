"""What was measured, as a document's table, as JSON and as pictures of what failed."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from deepshade import metrics, pictures
from deepshade.effects import EFFECTS, Effect
from deepshade.files import replacing
from deepshade_report.hardcases.measure import Row
from deepshade_report.hardcases.picture import Float

_MARKED = re.compile(r"(<!-- made: hardcases -->\n).*?(<!-- end -->)", re.DOTALL)


def worst_first(rows: Iterable[Row]) -> list[Row]:
    """Those that failed, then those nearest to their lines."""
    return sorted(rows, key=lambda row: (row.passed, -row.severity, row.key))


def markdown(rows: Sequence[Row], machine: str) -> str:
    """A line for each case, the worst first: which effect, engine and variant were worst of it."""
    cases: dict[str, list[Row]] = {}
    for row in worst_first(rows):
        cases.setdefault(row.case, []).append(row)
    failed = sum(not row.passed for row in rows)
    lines = [
        f"{len(rows)} rows, {failed} over their line; {machine}.",
        "",
        "| case | rows | failed | worst | against | error | line | off float64 | line | why |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for case, own in cases.items():
        first = own[0]
        variant = f", {first.variant}" if first.variant else ""
        lines.append(
            f"| {case} | {len(own)} | {sum(not row.passed for row in own)} "
            f"| {first.effect}/{first.bundle} {first.backend}{variant} "
            f"| {first.refused[:80] or first.against} | {_short(first.error)} "
            f"| {_short(first.line)} | {_short(first.float64)} | {_short(first.float64_line)} "
            f"| {first.why} |"
        )
    effects = dict.fromkeys(row.effect for row in rows)
    lines += [
        "",
        "| effect | rows | failed | nearest to its line | share of it |",
        "|---|---|---|---|---|",
    ]
    for effect in effects:
        own = worst_first(row for row in rows if row.effect == effect and row.case != "easy")
        if not own:
            continue
        first = own[0]
        variant = f", {first.variant}" if first.variant else ""
        share = "-" if math.isinf(first.severity) else f"{first.severity:.2f}"
        lines.append(
            f"| {effect} | {len(own)} | {sum(not row.passed for row in own)} "
            f"| {first.case}{variant}, {first.bundle} {first.backend} | {share} |"
        )
    return "\n".join(lines) + "\n"


def renew(document: Path, rows: Sequence[Row], machine: str) -> None:
    """Replace the table between the document's marks."""
    text = document.read_text("utf-8")
    with replacing(document) as part:
        made = markdown(rows, machine)
        part.write_text(_MARKED.sub(lambda found: found[1] + made + found[2], text), "utf-8")


def draw(folder: Path, row: Row, answer: Float, truth: Float) -> Path:
    """What came, what should have, and the difference, side by side as a PNG file."""
    effect: Effect = EFFECTS[row.effect]
    factor = np.float32(metrics.exposure(truth) if effect.is_light else 1.0)
    with np.errstate(over="ignore"):
        images = [np.nan_to_num(image * factor) for image in (answer, truth)]
    panels = [pictures.of_effect(image, effect) for image in images]
    panels.append(pictures.difference(*images))
    name = "-".join([*row.key[:3], row.case, row.variant])
    path = folder / f"{re.sub(r'[^A-Za-z0-9.+-]+', '_', name).strip('_')}.png"
    pictures.save(path, pictures.beside(panels))
    return path


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
