"""A bundle's figures and its model card."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from deepshade import bench
from deepshade.bundles import METRICS, Bundle, write_config
from deepshade.effects import EFFECTS, SETTINGS
from deepshade.engines import usable
from deepshade.files import replacing
from deepshade.machine import cpu_kind, describe
from deepshade_trainer.dataset import directions, lengths
from deepshade_trainer.evaluation import Variant, evaluate, summary
from deepshade_trainer.recipe import Recipe
from deepshade_trainer.run import Run

# The section on speed, or where it belongs: before what follows the errors.
_SPEED = re.compile(r"^## Speed\n.*?(?=^## |\Z)|(?=^## (?!Error))|\Z", re.MULTILINE | re.DOTALL)
MAX_INT8_ADDED = 0.01  # of the DSSIM in fp32
_WRITTEN = ("path", "metrics", "hashes")
_COLUMNS = {"ssim": ".4f", "psnr": ".2f", "mae": ".4f", "flip": ".4f", "smape": ".4f"}
_COLUMNS |= {"dssim": ".4f", "noise": ".4f", "trivial_dssim": ".4f", "ratio": ".3f"}


def variants(bundle: Bundle) -> dict[str, Variant]:
    """How a bundle's inputs are changed to see what it bears, by what its attributes are."""
    found = {"exact": Variant()}
    # Directions need no 16-bit row: shards hold them so.
    if half := tuple(lengths(bundle.inputs)):
        found["16-bit positions"] = Variant(half=half)
    if directions(bundle.inputs):
        found["normals 10 % too short"] = Variant(stretch=0.1)
    if half:
        found |= {f"scene x {scale:g}": Variant(scale=scale) for scale in (1e-3, 1e4)}
    return found


def measure(
    bundle: Bundle, folders: Sequence[Path], tell: Callable[[str], object] = lambda _: None
) -> Bundle:
    """The bundle with errors over each test folder and this machine's speed in its metrics.

    `error` holds, for each folder, the summary under every variant of the inputs in fp32, and in
    the 16 and 8 bits of this machine. Where 8 bits add little error on all folders, they are
    allowed on this kind of CPU. `tell` hears what is being measured.
    """
    errors: dict[str, dict[str, Any]] = {folder.name: {} for folder in folders}
    for folder in folders:
        found = errors[folder.name]
        for name, variant in variants(bundle).items():
            tell(f"measuring on {folder}: {name}")
            found[name] = summary(list(evaluate(bundle, [folder], variant=variant)))
        for backend in usable(bundle):
            if backend.precision != "fp32":
                tell(f"measuring on {folder}: {backend}")
                mean = summary(list(evaluate(bundle, [folder], backend=backend)))
                found[f"exact, {backend}"] = mean
    kinds = set(bundle.int8_kinds) - {cpu_kind()}
    added = [
        mean["dssim"] / found["exact"]["dssim"] - 1
        for found in errors.values()
        for name, mean in found.items()
        if name.endswith("/int8")
    ]
    if added and max(added) <= MAX_INT8_ADDED:
        kinds.add(cpu_kind())
    tell("measuring its speed")
    speeds = {
        **bundle.metrics.get("speed", {}),
        describe(): {"size": [bench.WIDTH, bench.HEIGHT], "ms": bench.milliseconds(bundle)},
    }
    metrics = {**bundle.metrics, "error": errors, "speed": speeds}
    config = {f.name: getattr(bundle, f.name) for f in fields(bundle) if f.name not in _WRITTEN}
    return write_config(bundle.path, {**config, "int8_kinds": sorted(kinds)}, metrics)


def record_speed(bundle: Bundle, machine: str, ms: Mapping[str, float]) -> None:
    """Put a machine's milliseconds at 768 x 512, by backend, in place of what the bundle has.

    In its metrics, and in its card, whose other sections stay.
    """
    path = bundle.path / METRICS
    speed = {"size": [bench.WIDTH, bench.HEIGHT], "ms": dict(ms)}
    metrics = {**bundle.metrics, "speed": {**bundle.metrics.get("speed", {}), machine: speed}}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", "utf-8")
    card = bundle.path / "README.md"
    section = "\n".join([*speed_section(metrics), ""])
    text = _SPEED.sub(lambda _: section, card.read_text("utf-8"), count=1)
    with replacing(card) as temporary:
        temporary.write_text(text, "utf-8")


def write_card(bundle: Bundle, run: Run | None, note: str) -> None:
    """Write the bundle's README.md from its configuration, figures and recipe, if it has one."""
    effect = EFFECTS[bundle.effect]
    lines = [
        f"# {bundle.effect}/{bundle.name}",
        "",
        f"Shades `{bundle.effect}` from {', '.join(bundle.inputs)}."
        + (
            f" Lengths are divided by the effect radius ({SETTINGS['radius'].default} unless the "
            "request or the image's header names one), so any scene scale works."
            if effect.lengths == "radius" and lengths(bundle.inputs)
            else " Lengths are divided by the picture's median depth."
            if lengths(bundle.inputs)
            else ""
        ),
        "",
        f"Sides are padded to multiples of {bundle.size_multiple}; a pixel depends on at most "
        f"{bundle.halo} pixels around it."
        if bundle.halo
        else "Any size will do: a pixel depends on itself alone.",
        "",
        *_errors(bundle),
        *speed_section(bundle.metrics),
    ]
    if run is not None:
        recipe = Recipe.read(run.recipe)
        # A path of this machine tells nobody anything; the folder's name is what the note speaks of
        recipe = recipe.changed(init_from=Path(recipe.init_from).name)
        lines += ["## Recipe", "", "```json", json.dumps(asdict(recipe), indent=1), "```", ""]
    text = "\n".join(lines) + ("\n" + note.strip() + "\n" if note else "")
    with replacing(bundle.path / "README.md") as temporary:
        temporary.write_text(text)


def _errors(bundle: Bundle) -> list[str]:
    """Error over each test set under every variant, beside the trivial answer's."""
    errors: dict[str, dict[str, Any]] = bundle.metrics.get("error", {})
    if not errors:
        told = "Not measured: 'deepshade export' without --test, or no test view that counts."
        return ["## Error", "", told, ""]
    effect = EFFECTS[bundle.effect]
    measures = {
        "deviation": "whose reference has a standard deviation of",
        "dssim": "on which the trivial answer's DSSIM is",
    }
    trivial = f"`{effect.trivial}`" if isinstance(effect.trivial, str) else f"{effect.trivial:g}"
    if effect.trivial in effect.inputs and "environment" in effect.settings:
        trivial += " times the environment's mean"
    means = [mean for found in errors.values() for mean in found.values()]
    columns = [name for name in _COLUMNS if all(name in mean for mean in means)]
    titles = [name.upper() if name not in ("trivial_dssim", "ratio") else name for name in columns]
    lines = [
        "## Error",
        "",
        f"Over views {measures[effect.contrast]} at least {effect.min_contrast:g}; the trivial "
        f"answer is {trivial} everywhere."
        + (
            " NOISE is the DSSIM of the reference with as much of its own noise again: about what "
            "it leaves to a perfect answer."
            if "noise" in columns
            else ""
        ),
        "",
        f"| test set | inputs | views | {' | '.join(titles)} |".replace("_dssim", " DSSIM"),
        "|---|---|---|" + "---|" * len(columns),
    ]
    for name, found in errors.items():
        for inputs, mean in found.items():
            figures = " | ".join(f"{mean[column]:{_COLUMNS[column]}}" for column in columns)
            lines.append(f"| {name} | {inputs} | {mean['views']} | {figures} |")
    return [*lines, ""]


def speed_section(metrics: Mapping[str, Any]) -> list[str]:
    """The bare network's speed on each machine that it was measured on."""
    speeds: dict[str, dict[str, Any]] = metrics.get("speed", {})
    if not speeds:
        return []
    lines = [
        "## Speed",
        "",
        "Milliseconds of the bare network on a machine that does nothing else, warm, all channels.",
        "",
        "| machine | engine | precision | size | ms |",
        "|---|---|---|---|---|",
    ]
    for machine, found in sorted(speeds.items()):
        width, height = found["size"]
        for name, ms in sorted(found["ms"].items(), key=lambda item: item[1]):
            engine, _, precision = name.partition("/")
            size = f"{width} x {height}"
            lines.append(f"| {machine} | {engine} | {precision} | {size} | {ms:.1f} |")
    return [*lines, ""]
