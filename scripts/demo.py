"""Serve the shipped shaders, shade the sample G-buffers by every effect, compare with references.

`make demo` runs this. Each sample is one request for all effects that it has references of.
out/demo gets the answer as EXR, a layer an effect, and for each effect a picture of ours, the
reference and the difference; `nine.png` shows all effects of samples/room.exr, ours on the left.
`--sheet FILE.webp` writes that for a page.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.console import Console
from rich.table import Table

from deepshade import exr, judging, metrics, pictures
from deepshade.bundles import bundle_folders
from deepshade.effects import EFFECTS, Effect
from deepshade_client import Client

Float = NDArray[np.float32]

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
MODELS = ROOT / "models"
SAMPLES = sorted((ROOT / "samples").glob("*.exr"), reverse=True)
OUT = Path("out/demo")
COLUMNS = 3  # effects beside each other in the sheet


@contextmanager
def service() -> Iterator[str]:
    """A service on a free loopback port; yields its address."""
    command = [str(BIN / "deepshade"), "serve", "--port", "0", "--log-level", "warning"]
    process = subprocess.Popen(
        [*command, "--models", str(MODELS)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        found = re.search(r"http://\S+", process.stdout.readline())
        if found is None:
            sys.exit("the service did not start; its message is above")
        yield found[0]
    finally:
        process.terminate()
        process.wait(30)


def compared(effect: Effect, sample: Path, ours: Float) -> tuple[list[pictures.Picture], float]:
    """Our answer (C, H, W), the reference and the difference, exposed alike; and the DSSIM."""
    names = [f"reference_{effect.name}.{band}" for band in ("RGB" if len(ours) == 3 else "V")]
    pixels = exr.read(sample, names).pixels
    reference = np.stack([pixels[name] for name in names])
    shown, truth = judging.exposed(effect, reference, ours, reference)
    row = [pictures.of_effect(shown, effect), pictures.of_effect(truth, effect)]
    return [*row, pictures.difference(shown, truth)], metrics.dssim(shown, truth)


def sheet(found: dict[str, list[pictures.Picture]]) -> pictures.Picture:
    """All effects, half as large, each with its title: ours, then the reference."""
    cells = []
    for name, (ours, reference, _) in found.items():
        whole = Image.fromarray(pictures.beside([ours, reference]))
        cell = whole.resize((whole.width // 2, whole.height // 2), Image.Resampling.BOX)
        ImageDraw.Draw(cell).text(
            (5, 3), EFFECTS[name].title, "white", stroke_width=2, stroke_fill="black"
        )
        cells.append(np.asarray(cell))
    cells += [np.full_like(cells[0], 255)] * (-len(cells) % COLUMNS)
    rows = [cells[k : k + COLUMNS] for k in range(0, len(cells), COLUMNS)]
    return pictures.below([pictures.beside(row) for row in rows])


def main() -> None:
    """Run the demo."""
    parser = argparse.ArgumentParser(description="Shades the samples by every effect.")
    parser.add_argument("--sheet", type=Path, help="where the picture of all goes as well (WebP)")
    asked = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    shipped = {folder.parent.name for folder in bundle_folders(MODELS)}
    table = Table("sample", "effect", "bundle", "SSIM", "DSSIM", "ms")
    shown: dict[str, list[pictures.Picture]] = {}
    with service() as server, Client(server) as client:
        client.wait_until_ready()
        for sample in SAMPLES:
            layers = "".join(exr.read_header(sample.read_bytes()).channels())
            names = [n for n in EFFECTS if n in shipped and f"reference_{n}." in layers]
            client.shade(",".join(names), sample)  # the first answer also compiles
            answer = client.shade(",".join(names), sample)
            answer.save(OUT / sample.name)
            for name, ours in answer.arrays().items():
                row, dssim = compared(EFFECTS[name], sample, ours)
                pictures.save(OUT / f"{sample.stem}-{name}.png", pictures.beside(row))
                shown.setdefault(name, row)
                alone = len(names) == 1
                bundle = answer.facts["bundle" if alone else f"{name}.bundle"]
                ms = answer.timing["infer" if alone else f"infer-{name}"]
                figures = f"{1 - 2 * dssim:.4f}", f"{dssim:.4f}", f"{ms:.0f}"
                table.add_row(sample.stem, name, bundle, *figures)
            for stage in ("decode", "encode"):
                table.add_row(sample.stem, stage, "", "", "", f"{answer.timing[stage]:.0f}")
    whole = sheet(shown)
    pictures.save(OUT / "nine.png", whole)
    if asked.sheet:
        Image.fromarray(whole).save(asked.sheet, "WEBP", quality=85, method=6)
    Console().print(table)
    print(f"Pictures: ours, the reference, the difference, in {OUT}/*.png; all in {OUT}/nine.png")


if __name__ == "__main__":
    main()
