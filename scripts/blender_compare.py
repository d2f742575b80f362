"""Compares answers on a frame of `blender_frame.py` with path tracing, and draws README's picture.

    deepshade render garage.gltf -o reference.exr --eye 0.6 1.55 1.2 --target -2.8 0.85 -2.2 \\
      --fov 60 --radius 0.6 --spp 1024 --attributes normal,position
    curl --fail-with-body --data-binary @out.exr -H 'Content-Type: image/x-exr' -o answer.exr \\
      'http://127.0.0.1:8000/shade/ao?quality=best&fov=60&radius=0.6'
    python scripts/blender_compare.py out.exr answer.exr reference.exr picture.png

glTF is y up and Blender z up: (x, y, z) in Blender is (x, z, -y) in the file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from deepshade import exr, metrics, pictures
from deepshade.camera import Camera
from deepshade.effects import EFFECTS
from deepshade.gbuffer import load_gbuffer
from deepshade_report.baselines.ao.gtao import gtao
from deepshade_report.baselines.ao.hbao import hbao
from deepshade_report.view import View


def main() -> None:
    """The command: prints each method's DSSIM."""
    parser = argparse.ArgumentParser(description="Compares answers on a Blender frame.")
    for name in ("frame", "answer", "reference", "picture"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--fov", type=float, default=60.0)
    parser.add_argument("--radius", type=float, default=0.6)
    options = parser.parse_args()
    gbuffer = load_gbuffer(options.frame, ("normal", "position"), fov=options.fov)
    reference = exr.read(options.reference, ["reference_ao.V"]).stack(["reference_ao.V"])
    height, width = gbuffer.shape
    camera = Camera(options.fov, width, height)
    view = View(
        options.frame.stem,
        EFFECTS["ao"],
        gbuffer.attributes,
        gbuffer.background,
        reference,
        options.radius,
        camera,
    )
    images = {"answer": exr.read(options.answer).stack(["Y"])}
    for name, method in (("GTAO", gtao(3, 6)), ("HBAO", hbao(8, 4))):
        method.prepare(view)
        images[name] = np.asarray(method.shade(view)).reshape(1, height, width)
    for name, image in images.items():
        print(f"{name}: DSSIM {metrics.dssim(image.clip(0, 1), reference):.4f}")
    channels = exr.read_header(options.frame).channels()
    combined = [next(c for c in channels if c.endswith(f"Combined.{band}")) for band in "RGB"]
    beauty = exr.read(options.frame, combined).stack(combined)
    beauty = beauty / np.percentile(beauty, 97)
    upper = [pictures.srgb(beauty), pictures.shading(images["GTAO"])]
    lower = [pictures.shading(images["answer"]), pictures.shading(reference)]
    pictures.save(options.picture, pictures.below([pictures.beside(upper), pictures.beside(lower)]))


if __name__ == "__main__":
    main()
