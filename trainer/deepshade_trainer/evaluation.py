"""Error of a bundle over a data set: SSIM, PSNR, MAE, FLIP, beside the trivial answer's."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import judging, metrics, pictures
from deepshade.bundles import Bundle
from deepshade.camera import camera_to_world
from deepshade.effects import Effect
from deepshade.engines import REFERENCE, Backend, load_engine
from deepshade.environments import Environment, Prepared, Surroundings
from deepshade.errors import ConfigError, DataError
from deepshade.machine import cpu_count
from deepshade_trainer.dataset import Dataset, Sample, directions, lengths, rounded, shortened

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Variant:
    """How inputs are changed before shading, to see what that costs.

    `half` names attributes rounded to 16 bits; `scale` multiplies all lengths and the radius;
    `stretch` multiplies directions by random lengths in [1 - stretch, 1].
    """

    half: tuple[str, ...] = ()
    scale: float = 1.0
    stretch: float = 0.0

    def apply(self, sample: Sample, inputs: Sequence[str], radius: float) -> tuple[Sample, float]:
        """The changed inputs and radius; the reference stays."""
        changed = dict(sample)
        if self.scale != 1:
            factor = np.float32(self.scale)
            changed |= {name: changed[name] * factor for name in lengths(inputs)}
        if self.stretch:
            rng = np.random.default_rng(0)
            changed |= shortened(changed, directions(inputs), 1 - self.stretch, rng)
        changed |= {name: rounded(changed[name]) for name in self.half}
        return changed, radius * self.scale


@dataclass(frozen=True)
class Row:
    """One view's figures, and its images as they are compared, in [0, 1].

    `number` is its place in the data, from 0: what tells views of one scene apart.
    `guide` shows its normals, or where the effect has none the trivial answer.
    """

    scene: str
    contrast: float
    figures: dict[str, float]
    image: Image
    reference: Image
    guide: pictures.Picture
    number: int = 0


@lru_cache(maxsize=8)  # about 75 MB each
def prepared(environment: Environment) -> Prepared:
    """What graphs and rivals look up in an environment; that of a few stays in memory."""
    return Prepared.of(environment)


class Shaded:
    """A bundle on an engine, for samples of any size."""

    def __init__(self, bundle: Bundle, backend: Backend = REFERENCE) -> None:
        self.bundle = bundle
        self.backend = backend
        self.engine = load_engine(bundle, backend, threads=cpu_count())

    def __call__(
        self,
        data: Dataset,
        sample: Sample,
        radius: float,
        lit: Surroundings | None = None,
    ) -> Image:
        """The answer (C, H, W), C of an effect run per channel from three runs.

        `lit` is the sample's environment (`Dataset.surroundings`), where the bundle takes one.
        """
        height, width = sample[data.reference].shape[1:]
        gbuffer = data.gbuffer(sample, radius, self.bundle.size_multiple)
        given: dict[str, Image] = {}
        if names := self.bundle.environment:
            if lit is None:
                raise DataError(f"the samples have no environment, which {self.bundle.name} needs")
            camera = partial(camera_to_world, sample)
            given = prepared(lit.environment).inputs(names, lit.degrees, lit.up, camera)
        shaded: Image = self.engine.predict(gbuffer, given)
        return shaded.reshape(-1, *shaded.shape[2:])[:, :height, :width]


def evaluate(
    bundle: Bundle,
    folders: Sequence[Path],
    *,
    numbers: Sequence[int] | None = None,
    min_contrast: float | None = None,
    limit: int | None = None,
    variant: Variant | None = None,
    backend: Backend = REFERENCE,
) -> Iterator[Row]:
    """Shade every sample that shows something: by default as much as the effect's row says.

    With `numbers` only those samples are looked at.

    Each is lit by the environment that it was rendered under. Where the references' error is known,
    the figure `noise` is what of the DSSIM it explains (`judging.floor`).

    Raises:
        DataError: no sample does.
        EngineError: this machine or this bundle lacks the backend.
    """
    data, shader = (
        Dataset(folders, bundle.effect, per_channel=bundle.per_channel, inputs=bundle.inputs),
        Shaded(bundle, backend),
    )
    effect, variant = data.effect, variant or Variant()
    least = effect.min_contrast if min_contrast is None else min_contrast
    for name in variant.half:
        if name not in bundle.inputs:
            raise ConfigError(name, bundle.inputs, detail=f"{bundle.effect} has no input {name!r}")
    found = 0
    for number in range(len(data.entries)) if numbers is None else numbers:
        entry = data.entries[number]
        sample = data.load(number)
        reference = sample[data.reference]
        lit = data.surroundings(number)
        blank = judging.trivial(effect, sample, reference, lit)
        contrast = judging.contrast(effect, reference, blank)
        if contrast < least:
            continue
        changed, radius = variant.apply(sample, bundle.inputs, data.radius(number))
        image = shader(data, changed, radius, lit)
        ours, truth, nothing = judging.exposed(effect, reference, image, reference, blank)
        figures = compare(ours, truth, nothing)
        if effect.is_light:
            figures["smape"] = judging.relative(reference, image)
        if (error := data.error(number)) is not None:
            figures["noise"] = judging.floor(effect, reference, error)
        guide = (
            pictures.normals(sample["normal"])
            if "normal" in sample
            else pictures.of_effect(nothing, effect)
        )
        yield Row(entry.record["scene"], contrast, figures, ours, truth, guide, number)
        found += 1
        if found == limit:
            return
    if not found:
        raise judging.nothing_shown(effect, ", ".join(map(str, folders)), least)


def compare(image: Image, reference: Image, trivial: Image) -> dict[str, float]:
    """Figures of one image (C, H, W) in [0, 1]; of light, `smape` is added unclipped."""
    ssim, blank = metrics.ssim(image, reference), metrics.ssim(trivial, reference)
    return {
        "ssim": ssim,
        "dssim": (1 - ssim) / 2,
        "psnr": metrics.psnr(image, reference),
        "mae": metrics.mae(image, reference),
        "flip": metrics.flip(image, reference),
        "trivial_ssim": blank,
        "trivial_dssim": (1 - blank) / 2,
    }


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Means over rows, and the ratio of mean DSSIM to the trivial answer's."""
    names = [name for name in rows[0].figures if all(name in row.figures for row in rows)]
    mean = {name: float(np.mean([row.figures[name] for row in rows])) for name in names}
    return {"views": len(rows), **mean, "ratio": mean["dssim"] / mean["trivial_dssim"]}


def short_names(names: Sequence[str]) -> list[str]:
    """Scenes' names without the folders that all of them that are files share."""
    files = [name for name in names if "/" in name and Path(name).suffix]
    shared = ""
    with suppress(ValueError):  # no files, or some by absolute paths and some by relative ones
        shared = os.path.commonpath([str(Path(name).parent) for name in files])
    return [str(Path(n).relative_to(shared)) if n in files and shared else n for n in names]


def contact_sheet(effect: Effect, rows: Sequence[Row], columns: int = 2) -> pictures.Picture:
    """Views side by side, each as its guide, our image, the reference, and the difference."""
    strips = [
        pictures.beside(
            [
                row.guide,
                pictures.of_effect(row.image, effect),
                pictures.of_effect(row.reference, effect),
                pictures.difference(row.image, row.reference),
            ]
        )
        for row in rows
    ]
    blank = np.full_like(strips[0], 255)
    strips += [blank] * (-len(strips) % columns)
    lines = [strips[k : k + columns] for k in range(0, len(strips), columns)]
    return pictures.below([pictures.beside(line) for line in lines])


def document(
    bundle: Bundle, rows: Sequence[Row], variant: Variant, backend: Backend = REFERENCE
) -> dict[str, Any]:
    """The whole evaluation as JSON."""
    return {
        "bundle": f"{bundle.effect}/{bundle.name}",
        "sha256": bundle.sha256,
        "engine": backend.engine,
        "precision": backend.precision,
        "inputs": asdict(variant),
        "mean": summary(rows),
        "views": [
            {"view": r.number, "scene": r.scene, "contrast": r.contrast, **r.figures} for r in rows
        ],
    }
