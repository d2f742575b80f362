"""What reading a G-buffer and writing an answer cost, against the OpenEXR library used plainly.

    python benchmarks/exr.py [--input view.exr] [--rounds 30] [--json]

Plainly means: the library decodes the whole file, with as many threads as there are, numpy converts
what is wanted to float32 and stacks it. That neither looks for background nor checks numbers, as
reading a G-buffer does. Each round measures ours and the plain way one after the other, so that
drift hits both alike; a ratio is the median over rounds of ours/plain. "library" is the library's
part of the plain way: what the decoding of these bytes takes at least.
Without `--input` the pictures are an analytic one, 768x512, in several kinds of files.
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from service import analytic_picture, spread

from deepshade import exr
from deepshade.gbuffer import load_gbuffer
from deepshade.machine import cpu_count, describe

TARGET = 1.15  # of the median ratio of the plainest file; the others have less to do than plainly
NEEDS = ("normal", "position")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--input", type=Path, help="EXR with normals and positions to read")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    OpenEXR.set_global_thread_count(cpu_count())
    files = {"given": options.input.read_bytes()} if options.input else dict(pictures())
    reading = {name: measure_reading(body, options.rounds) for name, body in files.items()}
    name = next(iter(reading))
    result = {
        "machine": describe(),
        "rounds": options.rounds,
        "reading": reading,
        "writing": measure_writing(options.rounds),
        "target": TARGET,
    }
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        show(result)
    return 0 if reading[name]["ratio"] <= TARGET and result["writing"]["ratio"] <= TARGET else 1


def pictures() -> Iterator[tuple[str, bytes]]:
    """The same normals and positions in several kinds of files, all half floats."""
    body = analytic_picture(512, 768)
    yield "6 channels, zip", body
    planes = {name: plane.astype(np.float16) for name, plane in exr.read(body).pixels.items()}
    rng = np.random.default_rng(0)
    noise = rng.random((512, 768)).astype(np.float16)
    # 34 others, of the smoothness of a render
    others = {
        f"pass{n:02}.{axis}": np.roll(planes["normal.X"], 20 * n) + noise * np.float16(0.01)
        for n in range(12)
        for axis in "RGB"
    }
    others = dict(list(others.items())[:34])
    yield "6 of 40 channels, zip", encode([(planes | others, "")])
    third = len(others) // 4
    passes = [
        (dict(list(others.items())[at : at + third]), f"pass{at}")
        for at in range(0, len(others), third)
    ]
    yield "1 of 6 parts, zip", encode([(planes, "gbuffer"), *passes])
    yield "6 channels, zip, tiled", encode([(planes, "")], tiled=True)
    yield "6 channels, none", encode([(planes, "")], compression=OpenEXR.NO_COMPRESSION)


def encode(
    parts: list[tuple[dict[str, Any], str]],
    *,
    compression: Any = OpenEXR.ZIP_COMPRESSION,
    tiled: bool = False,
) -> bytes:
    """A file of these parts, each (channels, name)."""
    made = []
    for channels, name in parts:
        header = {"compression": compression, "type": OpenEXR.scanlineimage}
        if tiled:
            tiles = OpenEXR.TileDescription()
            tiles.xSize = tiles.ySize = 64
            header |= {"type": OpenEXR.tiledimage, "tiles": tiles}
        made.append(OpenEXR.Part(header, channels, name))
    stream = io.BytesIO()
    OpenEXR.File(made).write(stream)
    return stream.getvalue()


def measure_reading(body: bytes, rounds: int) -> dict[str, Any]:
    """Milliseconds to read normals and positions from the bytes: ours, plainly, the library."""
    places = exr.read_header(body).channels()
    wanted = [places[name] for name in load_names(body)]

    def library() -> list[Any]:
        stream = io.BytesIO(body)
        with OpenEXR.File(stream, separate_channels=True, num_threads=cpu_count()) as file:
            return [{n: c.pixels for n, c in part.channels.items()} for part in file.parts]

    def plainly() -> Any:
        parts = library()
        return np.stack([parts[at][name].astype(np.float32) for at, name in wanted])

    def ours() -> Any:
        return load_gbuffer(body, NEEDS)

    gbuffer, plain = ours(), plainly()
    for at, name in enumerate(NEEDS):
        found = gbuffer.attributes[name][:, ~gbuffer.background]
        np.testing.assert_array_equal(found, plain[3 * at : 3 * at + 3, ~gbuffer.background])
    return compare({"ours": ours, "plainly": plainly, "library": library}, rounds) | {
        "bytes": len(body)
    }


def load_names(body: bytes) -> list[str]:
    """The channels of normals and positions, in order."""
    mapped = load_gbuffer(body, NEEDS).mapped
    return [name for need in NEEDS for name in mapped[need].split(" (")[0].split(", ")]


def measure_writing(rounds: int) -> dict[str, Any]:
    """Milliseconds to write one float32 plane as half: our ZIP, plainly, HTJ2K; and the sizes."""
    body = analytic_picture(512, 768)
    normal = exr.read(body).pixels["normal.Z"]
    # as smooth as an effect's answer, and nowhere 0
    shade = np.clip(0.3 + 0.7 * np.abs(normal), 0, 1).astype(np.float32)
    sizes = {}

    def plainly() -> None:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        stream = io.BytesIO()
        planes = {"Y": shade.astype(np.float16)}
        with OpenEXR.File(header, planes, num_threads=cpu_count()) as file:
            file.write(stream)
        sizes["plainly"] = len(stream.getvalue())

    def ours() -> None:
        stream = io.BytesIO()
        exr.write(stream, {"Y": shade}, half=True)
        sizes["ours"] = len(stream.getvalue())

    def htj2k() -> None:
        stream = io.BytesIO()
        exr.write(stream, {"Y": shade}, half=True, compression="htj2k256")
        sizes["htj2k256"] = len(stream.getvalue())

    ways = {"ours": ours, "plainly": plainly, "htj2k256": htj2k}
    return compare(ways, rounds) | {"bytes": sizes}


def compare(ways: dict[str, Callable[[], Any]], rounds: int) -> dict[str, Any]:
    """Times all the ways in turn, and the ratio of "ours" to "plainly"."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    warm_up = 2
    for turn in range(warm_up + rounds):
        for name, way in ways.items():
            start = time.perf_counter()
            way()
            if turn >= warm_up:
                times[name].append(1e3 * (time.perf_counter() - start))
    ratios = [a / b for a, b in zip(times["ours"], times["plainly"], strict=True)]
    return {
        "milliseconds": {name: spread(values) for name, values in times.items()},
        "ratio": round(statistics.median(ratios), 3),
    }


def show(result: dict[str, Any]) -> None:
    """Prints the result for people."""
    print(f"{result['machine']}  {result['rounds']} rounds")
    print(f"{'':36}{'ours':>9}{'plainly':>9}{'library':>9}   ratio")
    rows = {**result["reading"], "writing 1 channel, zip": result["writing"]}
    for name, row in rows.items():
        found = row["milliseconds"]
        cells = "".join(
            f"{found[way]['median']:9.1f}" if way in found else " " * 9
            for way in ("ours", "plainly", "library")
        )
        print(f"  {name:34}{cells}   {row['ratio']:5.2f}")
    writing = result["writing"]
    for way, size in writing["bytes"].items():
        print(f"  written {way:10}{writing['milliseconds'][way]['median']:9.1f} ms {size:9,} bytes")


if __name__ == "__main__":
    sys.exit(main())
