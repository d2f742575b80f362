"""Serve the shipped shaders, shade the sample G-buffers, compare with path tracing, stop.

`make demo` runs this. It writes, for each sample, the answer as EXR and a picture of normals,
our result, the reference and the difference to out/demo.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from deepshade import exr, metrics, pictures
from deepshade.gbuffer import load_gbuffer

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
SAMPLES = sorted((ROOT / "samples").glob("*.exr"))
OUT = Path("out/demo")


@contextmanager
def service() -> Iterator[str]:
    """A service on a free loopback port; yields its address."""
    command = [str(BIN / "deepshade"), "serve", "--port", "0", "--log-level", "warning"]
    process = subprocess.Popen(
        [*command, "--models", str(ROOT / "models")], stdout=subprocess.PIPE, text=True
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


def shade(server: str) -> dict[str, dict[str, float]]:
    """Shade the samples as a user would; the service's milliseconds for each stage."""
    command = [str(BIN / "deepshade-client"), "shade", "ao", *map(str, SAMPLES)]
    command += ["-o", str(OUT), "--server", server, "--json"]
    for _ in range(2):  # the first answers also warm the machine
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(f"shading failed: {done.stdout}")
    entries = json.loads(done.stdout)["pictures"]
    return {Path(entry["output"]).name: entry["milliseconds"] for entry in entries}


def main() -> None:
    """Run the demo."""
    OUT.mkdir(parents=True, exist_ok=True)
    with service() as server:
        timing = shade(server)
    table = Table("sample", "SSIM", "DSSIM", "all white's", "MAE", "decode", "infer", "encode")
    for sample in SAMPLES:
        image = exr.read(OUT / sample.name).pixels["Y"]
        reference = exr.read(sample, ["reference_ao.V"]).pixels["reference_ao.V"]
        normal = load_gbuffer(sample, ["normal"]).attributes["normal"]
        row = [
            pictures.normals(normal),
            pictures.shading(image),
            pictures.shading(reference),
            pictures.difference(image, reference),
        ]
        pictures.save(OUT / f"{sample.stem}.png", pictures.beside(row))
        shaded, white = np.clip(image, 0, 1), np.ones_like(reference)
        figures = [
            metrics.ssim(shaded, reference),
            metrics.dssim(shaded, reference),
            metrics.dssim(white, reference),
            metrics.mae(shaded, reference),
        ]
        stages = timing[sample.name]
        table.add_row(
            sample.stem,
            *(f"{figure:.4f}" for figure in figures),
            *(f"{stages[name]:.1f} ms" for name in ("decode", "infer", "encode")),
        )
    Console().print(table)
    print(f"Pictures: normals, ours, the reference, the difference, in {OUT}/*.png")


if __name__ == "__main__":
    main()
