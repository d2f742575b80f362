"""Damaged and hostile files, read in a child process so that a crash would be seen."""

import subprocess
import sys

import pytest

CHILD = r"""
import faulthandler, io, random, sys
import numpy as np, OpenEXR
from deepshade import exr
from deepshade.errors import DeepshadeError

faulthandler.enable()
seed, count = map(int, sys.argv[1:])
rng = np.random.default_rng(0)
planes = {n: rng.random((37, 29)).astype("f") for n in ("Z", "normal.X", "normal.Y", "normal.Z")}
planes["Z"][:34] = 1  # several chunks are alike
files = []
for compression in exr.COMPRESSIONS:
    body = io.BytesIO()
    exr.write(body, planes, half=["Z"], compression=compression, attributes={"m": np.eye(4)})
    files.append(body.getvalue())
for compression in (OpenEXR.ZIP_COMPRESSION, OpenEXR.PIZ_COMPRESSION, OpenEXR.DWAB_COMPRESSION):
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), {c: planes["Z"].copy()}, c) for c in "ab"]
    body = io.BytesIO()
    OpenEXR.File(parts).write(body)
    files.append(body.getvalue())
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    header |= {"type": OpenEXR.tiledimage, "tiles": tiles}
    body = io.BytesIO()
    OpenEXR.File(header, {"Z": planes["Z"].copy()}).write(body)
    files.append(body.getvalue())

random.seed(seed)
limits = exr.Limits(decoded_bytes=64 << 20, pixels=1 << 20)
words = [b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0"]
good = bad = 0
for _ in range(count):
    data = bytearray(random.choice(files))
    head = min(len(data), 700)
    kind = random.randrange(6)
    if kind == 0:
        for _ in range(random.randint(1, 4)):
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    elif kind == 1:
        for _ in range(random.randint(1, 3)):
            data[random.randrange(head)] = random.randrange(256)
    elif kind == 2:
        del data[random.randrange(len(data)) :]
    elif kind == 3:
        at = random.randrange(head - 4)
        data[at : at + 4] = random.choice(words)
    elif kind == 4:
        to, at = random.randrange(len(data)), random.randrange(len(data))
        size = random.randrange(64)
        data[to : to + size] = data[at : at + size]
    else:
        for _ in range(random.randint(1, 40)):
            data[random.randrange(head // 2, len(data))] = random.randrange(256)
    try:
        image = exr.read(bytes(data), limits=limits)
        good += 1
        assert all(p.dtype == np.float32 and p.ndim == 2 for p in image.pixels.values())
    except DeepshadeError as error:
        bad += 1
        assert str(error)
print(good, bad)
"""


@pytest.mark.parametrize("count", [300, pytest.param(5000, marks=pytest.mark.slow)])
def test_no_file_crashes_or_hangs_the_reader(count):
    child = subprocess.run(
        [sys.executable, "-c", CHILD, "11", str(count)], capture_output=True, text=True, timeout=120
    )
    assert child.returncode == 0, child.stderr[-2000:]
    good, bad = map(int, child.stdout.split()[-2:])
    assert good + bad == count
    assert bad > count // 3
