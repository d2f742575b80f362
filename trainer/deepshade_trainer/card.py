"""A bundle's figures and its model card."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from deepshade.bundles import METRICS, Bundle
from deepshade.files import replacing
from deepshade.machine import describe

from .evaluation import Shaded, Variant, evaluate, summary
from .recipe import Recipe
from .run import Run

SPEED_SIZE = (768, 512)
# Normals need no 16-bit row: shards hold them so.
VARIANTS = {
    "exact": Variant(),
    "16-bit positions": Variant(half=("position",)),
    "normals 10 % too short": Variant(stretch=0.1),
    "scene x 0.001": Variant(scale=1e-3),
    "scene x 10000": Variant(scale=1e4),
}


def measure(bundle: Bundle, folders: Sequence[Path]) -> Bundle:
    """Add error over each test folder, under every variant of the inputs, and speed."""
    errors = {
        folder.name: {
            name: summary(list(evaluate(bundle, [folder], variant=variant)))
            for name, variant in VARIANTS.items()
        }
        for folder in folders
    }
    found = {**bundle.metrics, "error": errors, "speed": speed(bundle)}
    with replacing(bundle.path / METRICS) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")
    return dataclasses.replace(bundle, metrics=found)


def speed(bundle: Bundle, repeats: int = 9) -> dict[str, Any]:
    """Median milliseconds of ONNX Runtime fp32 at `SPEED_SIZE`, and the machine."""
    width, height = SPEED_SIZE
    rng = np.random.default_rng(0)
    gbuffer = rng.normal(size=(6, height, width)).astype(np.float32)
    gbuffer[5] = -np.abs(gbuffer[5]) - 4
    shader, times = Shaded(bundle), []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        shader(gbuffer)
        times.append(1e3 * (time.perf_counter() - start))
    return {
        "size": [width, height],
        "engine": "ONNX Runtime fp32",
        "median_ms": round(float(np.median(times[2:])), 1),
        "machine": describe(),
    }


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
        speed_ = bundle.metrics["speed"]
        lines += [
            "",
            "## Speed",
            "",
            f"{speed_['median_ms']} ms at {speed_['size'][0]} x {speed_['size'][1]}, "
            f"{speed_['engine']}, {speed_['machine']}.",
            "",
        ]
    lines += ["## Recipe", "", "```json", json.dumps(asdict(recipe), indent=1), "```", ""]
    text = "\n".join(lines) + ("\n" + note.strip() + "\n" if note else "")
    with replacing(bundle.path / "README.md") as temporary:
        temporary.write_text(text)
