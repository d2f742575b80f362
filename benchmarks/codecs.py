"""Codecs of live frames: bytes and seconds of the CPU, on the planes of real G-buffers.

    OMP_NUM_THREADS=1 python benchmarks/codecs.py samples/room.exr [more.exr]

Each line is one codec on what a live frame holds: normals and light in 16 bits, depth in 32. The
fastest of some rounds counts. "Soonest below" is the link below which a codec is sooner through
than the one before it in the table, packing and unpacking included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deepshade import exr, live
from deepshade.live import codecs

ROUNDS = 5
ORDER = ("raw", "lz4", "zstd", "deflate", "htj2k")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Codecs of live frames.")
    parser.add_argument("pictures", type=Path, nargs="+")
    options = parser.parse_args()
    planes = [plane for path in options.pictures for plane in of(path)]
    size = sum(plane.nbytes for plane in planes)
    pixels = sum(plane.size for plane in planes)
    print(f"{len(planes)} planes, {size / 1e6:.2f} MB, {8 * size / pixels:.1f} bits a value")
    print("| codec | smaller by | bits a value | packs, MB/s | unpacks, MB/s | soonest below |")
    print("|---|---|---|---|---|---|")
    before: tuple[float, float] | None = None
    for codec in (name for name in ORDER if name in live.available()):
        blocks, packs = quickest(lambda codec=codec: [codecs.encode(p, codec) for p in planes])
        _, unpacks = quickest(
            lambda codec=codec, blocks=blocks: [
                codecs.decode(b, codec, p.dtype, p.shape)
                for b, p in zip(blocks, planes, strict=True)
            ]
        )
        bytes_ = sum(map(len, blocks))
        link = ""
        if before is not None and before[0] > bytes_:
            link = f"{8 * (before[0] - bytes_) / (packs + unpacks - before[1]) / 1e6:,.0f} Mbit/s"
        before = bytes_, packs + unpacks
        print(
            f"| `{codec}` | {size / bytes_:.2f} | {8 * bytes_ / pixels:.1f} "
            f"| {size / packs / 1e6:,.0f} | {size / unpacks / 1e6:,.0f} | {link} |"
        )


def of(path: Path) -> list[NDArray[Any]]:
    """The planes that a live frame of an EXR's G-buffer has."""
    image = exr.read(path)
    kinds = {"normal": "<f2", "light": "<f2", "Z": "<f4", "position": "<f4"}
    return [
        np.ascontiguousarray(plane, kinds[name.partition(".")[0]])
        for name, plane in image.pixels.items()
        if name.partition(".")[0] in kinds
    ]


def quickest(work: Callable[[], Any]) -> tuple[Any, float]:
    """(what it gives, the seconds of its fastest round)."""
    took = []
    for _ in range(ROUNDS):
        begun = time.process_time()
        found = work()
        took.append(time.process_time() - begun)
    return found, min(took)


if __name__ == "__main__":
    main()
