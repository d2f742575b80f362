"""A bundle's figures and its model card."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.bundles import METRICS, Bundle
from deepshade.engines import REFERENCE, load_engine, usable
from deepshade.errors import BundleError
from deepshade.files import replacing
from deepshade.machine import cpu_count, cpu_kind, describe
from deepshade_trainer.evaluation import Variant, evaluate, summary
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

SPEED_SIZE = (768, 512)
_BACKENDS = "## Engines and precision"
# Normals need no 16-bit row: shards hold them so.
VARIANTS = {
    "exact": Variant(),
    "16-bit positions": Variant(half=("position",)),
    "normals 10 % too short": Variant(stretch=0.1),
    "scene x 0.001": Variant(scale=1e-3),
    "scene x 10000": Variant(scale=1e4),
}


def measure(bundle: Bundle, folders: Sequence[Path]) -> Bundle:
    """Add to its metrics: errors over each test folder, and what every backend here adds.

    `error` holds, for each folder, the summary under every variant of the inputs in fp32.
    """
    errors = {
        folder.name: {
            name: summary(list(evaluate(bundle, [folder], variant=variant)))
            for name, variant in VARIANTS.items()
        }
        for folder in folders
    }
    found = _with_metrics(bundle, {"error": errors})
    # Of real views, by habit: the backends take as long as all the variants.
    return measure_backends(found, folders[-1])


def measure_backends(bundle: Bundle, folder: Path) -> Bundle:
    """Add to its metrics the speed of every backend here, and what it adds to the error.

    Under `backends`, by kind of CPU: the machine, milliseconds, and for the test folder each other
    backend's summary, with `added`, its DSSIM over that in fp32 - 1. Other kinds' stay.
    """
    exact = summary(list(evaluate(bundle, [folder])))["dssim"]
    tests: dict[str, Any] = {}
    for backend in usable(bundle):
        if backend != REFERENCE:
            mean = summary(list(evaluate(bundle, [folder], backend=backend)))
            tests[str(backend)] = {**mean, "added": mean["dssim"] / exact - 1}
    here = {**speed(bundle), "tests": {folder.name: tests}}
    others = bundle.metrics.get("backends", {})
    kept = {kind: found for kind, found in others.items() if found.keys() >= here.keys()}
    return _with_metrics(bundle, {"backends": {**kept, cpu_kind(): here}})


def _with_metrics(bundle: Bundle, more: dict[str, Any]) -> Bundle:
    found = {**bundle.metrics, **more}
    with replacing(bundle.path / METRICS) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    return dataclasses.replace(bundle, metrics=found)


def speed(bundle: Bundle, repeats: int = 9) -> dict[str, Any]:
    """Median milliseconds at `SPEED_SIZE` of each backend, in turns, and the machine."""
    width, height = SPEED_SIZE
    step = bundle.size_multiple
    rows, columns = -(-height // step) * step, -(-width // step) * step
    rng = np.random.default_rng(0)
    backends = usable(bundle)
    engines = [load_engine(bundle, backend, threads=cpu_count()) for backend in backends]
    gbuffer = rng.normal(size=(1, engines[0].channels, rows, columns)).astype(np.float32)
    gbuffer[:, 5:6] = -np.abs(gbuffer[:, 5:6]) - 4
    for engine in engines:
        engine.warm()
        engine.prepare(rows, columns)
    times: dict[str, list[float]] = {str(backend): [] for backend in backends}
    for turn in range(repeats + 2):
        for engine in engines:
            start = time.perf_counter()
            engine.predict(gbuffer)
            if turn > 1:
                times[str(engine.backend)].append(1e3 * (time.perf_counter() - start))
    medians = {name: round(float(np.median(taken)), 2) for name, taken in times.items()}
    return {"machine": describe(), "size": [width, height], "ms": medians}


def write_card(bundle: Bundle, run: Run, note: str) -> None:
    """Write the bundle's README.md from its configuration, figures and recipe."""
    recipe = Recipe.read(run.recipe)
    lines = [
        f"# {bundle.effect}/{bundle.name}",
        "",
        f"Shades `{bundle.effect}` from {', '.join(bundle.inputs)}. "
        f"Positions are divided by the effect radius ({bundle.radius:g} scene units unless the "
        "request or the image's header names one), so any scene scale works.",
        "",
        f"Sides are padded to multiples of {bundle.size_multiple}; a pixel depends on at most "
        f"{bundle.halo} pixels around it.",
        "",
    ]
    errors = bundle.metrics.get("error", {})
    if errors:
        lines += [
            "## Error",
            "",
            "Over views whose reference has a standard deviation of at least 0.12; the trivial "
            "answer is all white.",
            "",
            "| test set | inputs | views | SSIM | PSNR | MAE | FLIP | DSSIM | trivial DSSIM "
            "| ratio |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]
        for name, variants in errors.items():
            for inputs, mean in variants.items():
                lines.append(
                    f"| {name} | {inputs} | {mean['views']} | {mean['ssim']:.4f} "
                    f"| {mean['psnr']:.2f} | {mean['mae']:.4f} | {mean['flip']:.4f} "
                    f"| {mean['dssim']:.4f} | {mean['trivial_dssim']:.4f} "
                    f"| {mean['ratio']:.3f} |"
                )
        lines += ["", *_backends(bundle)]
    # A path of this machine tells nobody anything; the folder's name is what the note speaks of.
    recipe = recipe.changed(start=Path(recipe.start).name)
    lines += ["## Recipe", "", "```json", json.dumps(asdict(recipe), indent=1), "```", ""]
    text = "\n".join(lines) + ("\n" + note.strip() + "\n" if note else "")
    with replacing(bundle.path / "README.md") as temporary:
        temporary.write_text(text)


def refresh(bundle: Bundle, make: Callable[[], Bundle]) -> None:
    """Write the table of backends in the bundle's card anew, after `make` has changed the figures.

    All else in the bundle's README.md stays.

    Raises:
        BundleError: there is no card with such a table; nothing was made.
    """
    path = bundle.path / "README.md"
    text = path.read_text() if path.is_file() else ""
    before, heading, after = text.partition(_BACKENDS + "\n")
    if not heading:
        raise BundleError(f"{path} has no part '{_BACKENDS}'", fix="export the bundle again")
    _, next_heading, rest = after.partition("\n## ")
    lines = _backends(make())
    with replacing(path) as temporary:
        temporary.write_text(before + "\n".join(lines) + next_heading + rest)


def _backends(bundle: Bundle) -> list[str]:
    """Speed and error of every engine and precision, as a table for each kind of CPU."""
    kinds: dict[str, Any] = bundle.metrics["backends"]
    lines = [
        _BACKENDS,
        "",
        "Milliseconds of the network, and what each precision adds to the DSSIM of fp32, by what "
        "the CPU multiplies 8 bits with.",
        "",
    ]
    for kind, found in sorted(kinds.items()):
        width, height = found["size"]
        tests: dict[str, Any] = found["tests"]
        added = " | ".join(f"added on {name}" for name in tests)
        lines += [
            f"### {kind}: {found['machine']}",
            "",
            f"| engine | precision | ms at {width} x {height} | {added} |",
            "|---|---|---|" + "---|" * len(tests),
        ]
        for name, milliseconds in sorted(found["ms"].items(), key=lambda item: item[1]):
            engine, _, precision = name.partition("/")
            errors = [
                f"{100 * test[name]['added']:+.2f} %" if name in test else "0"
                for test in tests.values()
            ]
            lines.append(f"| {' | '.join([engine, precision, f'{milliseconds:.1f}', *errors])} |")
        lines.append("")
    return lines
