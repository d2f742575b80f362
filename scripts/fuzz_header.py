"""Coverage-guided fuzzing of the header parser (needs the extra `fuzz`, on Linux).

Anything but a header or a DeepshadeError is a finding: it is written to the corpus folder's parent
as crash-…, and ends the run. Ends by itself after --seconds. What reached new code is added to the
corpus; `--keep` then copies some of those files, of every size.

    python scripts/fuzz_header.py out/corpus --seconds 3600
    python scripts/fuzz_header.py out/corpus --keep tests/core/headers
"""

from __future__ import annotations

import argparse
import hashlib
import io
import sys
from pathlib import Path

import atheris
import numpy as np

with atheris.instrument_imports(include=["deepshade.exr"]):
    from deepshade import exr
    from deepshade.errors import DeepshadeError

MAX_BYTES = 2048
LIMITS = exr.Limits(decoded_bytes=64 << 20, pixels=1 << 22)


def seeds() -> list[bytes]:
    """Small files of every compression, one and several parts, tiled, with attributes."""
    import OpenEXR

    plane = np.zeros((2, 3), np.float32)
    found = []
    facts = {"m": np.eye(4, dtype=np.float32), "v": np.ones(2, np.float32), "s": "text", "i": 3}
    for compression in exr.COMPRESSIONS:
        stream = io.BytesIO()
        exr.write(stream, {"Z": plane, "normal.X": plane}, compression=compression)
        found.append(stream.getvalue())
    stream = io.BytesIO()
    exr.write(stream, {"Z": plane}, half=["Z"], attributes=facts, data_window=(-1, 4, 1, 5))
    found.append(stream.getvalue())
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), {name: plane.copy()}, name) for name in "ab"]
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    found.append(stream.getvalue())
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    stream = io.BytesIO()
    tiled = header | {"type": OpenEXR.tiledimage, "tiles": tiles}
    OpenEXR.File(tiled, {"Z": plane.copy()}).write(stream)
    found.append(stream.getvalue())
    return found


def check(data: bytes) -> None:
    """One input: a header or an error that says something."""
    try:
        header = exr.read_header(data, LIMITS)
    except DeepshadeError as error:
        assert str(error)
        return
    assert header.parts
    for part in header.parts:
        height, width = part.shape
        assert height > 0 and width > 0 and part.channels


def keep(corpus: Path, folder: Path, most: int) -> None:
    """Copy at most so many files, from the smallest to the largest: each reached something new."""
    folder.mkdir(parents=True, exist_ok=True)
    files = sorted(corpus.iterdir(), key=lambda file: file.stat().st_size)
    for file in files[:: -(-len(files) // most)]:
        content = file.read_bytes()
        (folder / f"{hashlib.sha256(content).hexdigest()[:12]}.exr").write_bytes(content)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("corpus", type=Path)
    parser.add_argument("--seconds", type=int, default=3600)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--most", type=int, default=60, help="files that --keep may copy")
    asked = parser.parse_args()
    asked.corpus.mkdir(parents=True, exist_ok=True)
    if asked.keep:
        keep(asked.corpus, asked.keep, asked.most)
        sys.exit(0)
    options = [f"-max_len={MAX_BYTES}", "-rss_limit_mb=2048", "-timeout=20"]
    for number, seed in enumerate(seeds()):
        (asked.corpus / f"seed-{number}").write_bytes(seed)
    options += [f"-max_total_time={asked.seconds}", f"-artifact_prefix={asked.corpus.parent}/"]
    options += [str(asked.corpus)]
    atheris.Setup([sys.argv[0], *options], check)
    atheris.Fuzz()
