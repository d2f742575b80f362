"""Error of a bundle over a data set: SSIM, PSNR, MAE, FLIP, beside the trivial answer's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import metrics, pictures
from deepshade.bundles import Bundle
from deepshade.engines import REFERENCE, Backend, load_engine
from deepshade.errors import ConfigError, DataError
from deepshade.machine import cpu_count
from deepshade_trainer.dataset import Dataset, Sample, rounded

Image = NDArray[np.float32]
FIGURES = ("ssim", "dssim", "psnr", "mae", "flip", "trivial_ssim", "trivial_dssim")


@dataclass(frozen=True)
class Variant:
    """How inputs are changed before shading, to see what that costs.

    `half` names attributes rounded to 16 bits; `scale` multiplies the scene and the radius;
    `stretch` multiplies normals by random lengths in [1 - stretch, 1].
    """

    half: tuple[str, ...] = ()
    scale: float = 1.0
    stretch: float = 0.0

    def apply(self, sample: Sample, radius: float) -> tuple[Sample, float]:
        """The changed inputs and radius; the reference stays."""
        changed = dict(sample)
        if self.scale != 1:
            changed["position"] = changed["position"] * np.float32(self.scale)
        if self.stretch:
            shape = (1, *changed["normal"].shape[1:])
            lengths = np.random.default_rng(0).uniform(1 - self.stretch, 1, shape)
            changed["normal"] = changed["normal"] * lengths.astype(np.float32)
        for name in self.half:
            changed[name] = rounded(changed[name])
        return changed, radius * self.scale


@dataclass(frozen=True)
class Row:
    """One view's figures and pictures."""

    scene: str
    contrast: float
    figures: dict[str, float]
    normal: Image
    image: Image
    reference: Image


class Shaded:
    """A bundle on an engine, for G-buffers of any size."""

    def __init__(self, bundle: Bundle, backend: Backend = REFERENCE) -> None:
        self.bundle = bundle
        self.backend = backend
        self.engine = load_engine(bundle, backend, threads=cpu_count())

    def __call__(self, gbuffer: Image) -> Image:
        """Shade (C, H, W): zero-padded to the size multiple, cropped again."""
        height, width = gbuffer.shape[1:]
        step = self.bundle.size_multiple
        pad = ((0, 0), (0, -height % step), (0, -width % step))
        shaded: Image = self.engine.predict(np.pad(gbuffer, pad)[None])[0]
        return shaded[:, :height, :width]


def evaluate(
    bundle: Bundle,
    folders: Sequence[Path],
    *,
    min_contrast: float = 0.12,
    limit: int | None = None,
    variant: Variant | None = None,
    backend: Backend = REFERENCE,
) -> Iterator[Row]:
    """Shade every sample whose reference has at least `min_contrast` standard deviation.

    Raises:
        DataError: no sample has.
        EngineError: this machine or this bundle lacks the backend.
    """
    data, shader = Dataset(folders, bundle.effect), Shaded(bundle, backend)
    variant = variant or Variant()
    for name in variant.half:
        if name not in bundle.inputs:
            raise ConfigError(name, bundle.inputs, detail=f"{bundle.effect} has no input {name!r}")
    found = 0
    for number, entry in enumerate(data.entries):
        sample = data.load(number)
        reference = np.clip(sample[data.reference], 0, 1)
        contrast = float(reference.std())
        if contrast < min_contrast:
            continue
        changed, radius = variant.apply(sample, float(entry.record["radius"]))
        image = np.clip(shader(data.gbuffer(changed, radius)), 0, 1)
        yield Row(
            entry.record["scene"],
            contrast,
            compare(image, reference, np.full_like(reference, data.effect.background)),
            sample["normal"],
            image,
            reference,
        )
        found += 1
        if found == limit:
            return
    if not found:
        raise DataError(
            f"no sample has a contrast of {min_contrast}",
            fix="render views that show more, or lower --min-contrast",
        )


def compare(image: Image, reference: Image, trivial: Image) -> dict[str, float]:
    """`FIGURES` of one image (C, H, W) in [0, 1]."""
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
    mean = {name: float(np.mean([row.figures[name] for row in rows])) for name in FIGURES}
    return {"views": len(rows), **mean, "ratio": mean["dssim"] / mean["trivial_dssim"]}


def table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """JSON-ready figures of each view."""
    return [{"scene": r.scene, "contrast": r.contrast, **r.figures} for r in rows]


def contact_sheet(rows: Sequence[Row], columns: int = 2) -> pictures.Picture:
    """Views side by side, each as normals, our image, the reference, and the difference."""
    strips = [
        pictures.beside(
            [
                pictures.normals(row.normal),
                pictures.shading(row.image),
                pictures.shading(row.reference),
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
        "views": table(rows),
    }
