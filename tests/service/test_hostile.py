"""At least 200 damaged, truncated, hostile or absurd uploads against a real server process.

Each must get a 4xx problem document, the process's memory must come back to where it was, and a
good request must still work. Everything is generated here, headers by hand:
OpenEXR would not write most of them.
"""

from __future__ import annotations

import io
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import httpx
import numpy as np
import pytest

from deepshade import exr

EXR = "image/x-exr"
MAGIC = struct.pack("<I", 20000630)
CHANNELS = tuple(f"{name}.{axis}" for name in ("normal", "position") for axis in "XYZ")
LIMITS = {
    "--max-body": "8M",
    "--max-decoded": "300M",
    "--max-pixels": "4194304",
    "--max-parts": "8",
    "--max-channels": "64",
}


@dataclass(frozen=True)
class Upload:
    name: str
    body: bytes
    kind: str = EXR
    query: str = ""


def attribute(name: bytes, kind: bytes, value: bytes, size: int | None = None) -> bytes:
    length = len(value) if size is None else size
    return name + b"\0" + kind + b"\0" + struct.pack("<i", length) + value


def channel_list(names, kind=1, sampling=(1, 1)) -> bytes:
    entries = (n.encode() + b"\0" + struct.pack("<iB3xii", kind, 0, *sampling) for n in names)
    return b"".join(entries) + b"\0"


def box(x0, y0, x1, y1) -> bytes:
    return struct.pack("<4i", x0, y0, x1, y1)


def header(**changes: bytes | None) -> bytes:
    """A correct 32x32 half ZIP header, with attributes replaced or left out (None)."""
    entries: dict[str, tuple[bytes, bytes]] = {
        "channels": (b"chlist", channel_list(sorted(CHANNELS))),
        "compression": (b"compression", b"\3"),
        "dataWindow": (b"box2i", box(0, 0, 31, 31)),
        "displayWindow": (b"box2i", box(0, 0, 31, 31)),
        "lineOrder": (b"lineOrder", b"\0"),
        "pixelAspectRatio": (b"float", struct.pack("<f", 1)),
        "screenWindowCenter": (b"v2f", struct.pack("<2f", 0, 0)),
        "screenWindowWidth": (b"float", struct.pack("<f", 1)),
    }
    parts = []
    for name, (kind, value) in entries.items():
        new = changes.get(name, value)
        if new is not None:
            parts.append(attribute(name.encode(), kind, new))
    return b"".join(parts) + b"\0"


def image(head: bytes, *, version: int = 2, chunks: int = 2, data: bytes | None = None) -> bytes:
    """A single-part file: magic, version, header, chunk table, chunks that claim some bytes."""
    start = 8 + len(head) + 8 * chunks
    payload = zlib.compress(bytes(16 * 32 * 12)) if data is None else data
    body, offsets = b"", []
    for index in range(chunks):
        offsets.append(start + len(body))
        body += struct.pack("<ii", 16 * index, len(payload)) + payload
    return MAGIC + struct.pack("<I", version) + head + struct.pack(f"<{chunks}Q", *offsets) + body


def good(height=32, width=32, seed=0, names=CHANNELS, dtype=np.float16, **options) -> bytes:
    rng = np.random.default_rng(seed)
    pixels = {name: rng.normal(size=(height, width)).astype(dtype) for name in names}
    if "position.Z" in pixels:
        pixels["position.Z"] = -3 - np.abs(pixels["position.Z"])
    stream = io.BytesIO()
    exr.write(stream, pixels, half=dtype == np.float16, **options)
    return stream.getvalue()


def truncations() -> Iterator[Upload]:
    body = good()
    for at in np.unique(np.linspace(1, len(body) - 1, 60).astype(int)):
        yield Upload(f"cut at {at} of {len(body)}", body[:at])
    flat = good(compression="none")
    for at in np.unique(np.linspace(9, len(flat) - 1, 20).astype(int)):
        yield Upload(f"uncompressed, cut at {at}", flat[:at])


def flips() -> Iterator[Upload]:
    """Bytes that hold structure; a flip among pixels may well leave a valid picture."""
    body = good()
    for at in range(8):
        changed = bytearray(body)
        changed[at] ^= 0xFF
        yield Upload(f"flipped byte {at} of magic and version", bytes(changed))
    for name in (b"channels\0", b"dataWindow\0", b"compression\0", b"lineOrder\0"):
        at = body.index(name)
        for offset in range(0, len(name) - 1, 2):
            changed = bytearray(body)
            changed[at + offset] ^= 0x55
            yield Upload(f"flipped byte {offset} of the name {name[:-1].decode()}", bytes(changed))
        kind = at + len(name)
        size = body.index(b"\0", kind) + 1
        for byte in range(4):
            changed = bytearray(body)
            changed[size + byte] ^= 0xA5
            yield Upload(f"flipped size byte {byte} of {name[:-1].decode()}", bytes(changed))
    # Two chunks: the first entry of the table points just past the table.
    table = next(p for p in range(8, len(body)) if struct.unpack_from("<Q", body, p)[0] == p + 16)
    for byte in range(16):
        changed = bytearray(body)
        changed[table + byte] ^= 0xF0
        yield Upload(f"flipped byte {byte} of the chunk table", bytes(changed))
    first = struct.unpack_from("<Q", body, table)[0]
    for byte in range(8):
        changed = bytearray(body)
        changed[first + byte] ^= 0xF0
        yield Upload(f"flipped byte {byte} of the first chunk's head", bytes(changed))
    for byte in range(2):
        changed = bytearray(body)
        changed[first + 8 + byte] ^= 0xFF
        yield Upload(f"flipped byte {byte} of the first chunk's zlib stream", bytes(changed))


def windows() -> Iterator[Upload]:
    most = 2**31 - 1
    for name, window in {
        "huge": (0, 0, 99_999, 99_999),
        "maximal": (-(2**31), -(2**31), most, most),
        "overflowing": (-(2**31), 0, most, 0),
        "wide": (0, 0, most, 0),
        "tall": (0, 0, 0, most),
        "negative": (10, 10, 0, 0),
        "empty": (0, 0, -1, -1),
        "8192 squared plus one": (0, 0, 8192, 8191),
        "far away": (2**30, 2**30, 2**30 + 31, 2**30 + 31),
        "shifted": (5, 5, 36, 36),
        "larger than its chunks": (0, 0, 31, 63),
    }.items():
        yield Upload(f"{name} data window", image(header(dataWindow=box(*window))))
    for name, window in {
        "negative": (10, 10, 0, 0),
        "maximal": (-(2**31),) * 2 + (most,) * 2,
    }.items():
        yield Upload(f"{name} display window", image(header(displayWindow=box(*window))))
    yield Upload("a window of the wrong size", image(header(dataWindow=bytes(12))))


def headers() -> Iterator[Upload]:
    for name in (
        "channels",
        "compression",
        "dataWindow",
        "displayWindow",
        "lineOrder",
        "pixelAspectRatio",
        "screenWindowCenter",
        "screenWindowWidth",
    ):
        yield Upload(f"no {name}", image(header(**{name: None})))
        if name != "channels":
            yield Upload(f"{name} of no bytes", image(header(**{name: b""})))
    for code in (12, 50, 127, 200, 255):
        yield Upload(f"compression {code}", image(header(compression=bytes([code]))))
    # ZIP bytes that claim to be something else; PXR24 (5) is left out, as it would be valid
    for code in (1, 4, 6, 7, 8, 9):
        yield Upload(f"ZIP data as compression {code}", image(header(compression=bytes([code]))))
    yield Upload("an empty list of channels", image(header(channels=b"\0")))
    yield Upload("channels without an end", image(header(channels=b"")))
    yield Upload(
        "10,000 channels", image(header(channels=channel_list(f"c{i}" for i in range(10_000))))
    )
    yield Upload(
        "100,000 channels", image(header(channels=channel_list(f"{i}" for i in range(100_000))))
    )
    yield Upload("65 channels", image(header(channels=channel_list(f"c{i}" for i in range(65)))))
    doubled = channel_list(["normal.X", *CHANNELS])
    yield Upload("a channel twice", image(header(channels=doubled)))
    for kind in (3, 7, -1, 2**31 - 1):
        yield Upload(f"pixel type {kind}", image(header(channels=channel_list(CHANNELS, kind))))
    for sampling in ((0, 1), (1, 0), (-1, 1), (2, 2), (2**31 - 1, 1)):
        value = channel_list(CHANNELS, 1, sampling)
        yield Upload(f"sampling {sampling}", image(header(channels=value)))
    yield Upload("a channel name of 300 bytes", image(header(channels=channel_list(["n" * 300]))))
    yield Upload("a channel name of 1 MB", image(header(channels=channel_list(["n" * 10**6]))))
    yield Upload(
        "control characters as a channel", image(header(channels=channel_list(["\r\nX: y"])))
    )
    long = attribute(b"n" * 5000, b"int", bytes(4))
    yield Upload("an attribute name of 5,000 bytes", image(long + header()))
    yield Upload(
        "an attribute type of 5,000 bytes", image(attribute(b"a", b"t" * 5000, b"") + header())
    )
    many = b"".join(attribute(b"a%d" % i, b"int", bytes(4)) for i in range(50_000))
    yield Upload("50,000 attributes", image(many + header()))
    twice = attribute(b"compression", b"compression", b"\0")
    yield Upload("an attribute twice", image(twice + header()))
    for size in (-1, -(2**31), 2**31 - 1, 2**30, 10_000):
        lie = attribute(b"comment", b"string", b"hello", size)
        yield Upload(f"an attribute of {size} bytes", image(lie + header()))
    yield Upload("a header without an end", MAGIC + struct.pack("<I", 2) + header()[:-1])
    yield Upload("nothing but zeros after the magic", MAGIC + bytes(1000))
    yield Upload("a million zeros after the version", MAGIC + struct.pack("<I", 2) + bytes(10**6))
    for version in (0, 1, 3, 255, 2 | 0x10000, 2 | 0x80000000):
        yield Upload(f"version {version:#x}", image(header(), version=version))
    yield Upload("deep", image(header(), version=2 | 0x800))
    yield Upload("tiled without tiles", image(header(), version=2 | 0x200))
    for width, height in ((0, 0), (2**32 - 1, 1), (2**31, 2**31), (65536, 65536)):
        tiles = attribute(b"tiles", b"tiledesc", struct.pack("<2IB", width, height, 0))
        yield Upload(f"tiles of {width} x {height}", image(tiles + header(), version=2 | 0x200))
    mode = attribute(b"tiles", b"tiledesc", struct.pack("<2IB", 16, 16, 255))
    yield Upload("an unknown tile mode", image(mode + header(), version=2 | 0x200))


def chunks() -> Iterator[Upload]:
    for count in (0, 1):  # more than needed would be harmless
        yield Upload(f"{count} chunks instead of 2", image(header(), chunks=count))
    for name, data in {
        "no data": b"",
        "garbage": bytes(range(256)) * 4,
        "too little": zlib.compress(bytes(100)),
        "too much": zlib.compress(bytes(10**6)),
        "a bomb": zlib.compress(bytes(50 * 10**6), 9),
        "an unfinished stream": zlib.compress(bytes(6144))[:-6],
    }.items():
        yield Upload(f"chunks of {name}", image(header(), data=data))
    body = bytearray(image(header()))
    table = 8 + len(header())
    for name, offset in {
        "zero": 0,
        "into the header": 12,
        "into the table": table,
        "at the end": len(body),
        "far out": 2**40,
        "maximal": 2**64 - 1,
        "negative": 2**63,
    }.items():
        changed = body.copy()
        changed[table : table + 8] = struct.pack("<Q", offset)
        yield Upload(f"chunk offset {name}", bytes(changed))
    same = body.copy()
    same[table + 8 : table + 16] = same[table : table + 8]
    yield Upload("one chunk for two", bytes(same))
    first = struct.unpack_from("<Q", body, table)[0]
    for size in (-1, -(2**31), 2**31 - 1, 10**6):
        changed = body.copy()
        changed[first + 4 : first + 8] = struct.pack("<i", size)
        yield Upload(f"a chunk of {size} bytes", bytes(changed))


def parts(count: int, **changes: bytes) -> bytes:
    named = (
        attribute(b"name", b"string", b"p%d" % i)
        + attribute(b"type", b"string", b"scanlineimage")
        + attribute(b"chunkCount", b"int", struct.pack("<i", 2))
        + header(**changes)
        for i in range(count)
    )
    return MAGIC + struct.pack("<I", 2 | 0x1000) + b"".join(named) + b"\0" + bytes(16 * count)


def multipart_files() -> Iterator[Upload]:
    for count in (9, 100, 5000):
        yield Upload(f"{count} parts", parts(count))
    yield Upload("two parts without chunks", parts(2))
    yield Upload("parts with huge windows", parts(3, dataWindow=box(0, 0, 99_999, 99_999)))
    yield Upload("endless parts", parts(3)[:-49])
    unnamed = MAGIC + struct.pack("<I", 2 | 0x1000) + header() + b"\0" + bytes(16)
    yield Upload("a part without a name", unnamed)


def bombs() -> Iterator[Upload]:
    """Zeros compress about 900:1, so the upload is small and the picture is not."""
    big = np.zeros((4096, 4096), np.float16)
    stream = io.BytesIO()
    exr.write(stream, {"Z": big}, half=True)
    yield Upload("4096 squared zeros", stream.getvalue())
    wide = np.zeros((2048, 2048), np.float32)
    stream = io.BytesIO()
    exr.write(stream, {f"{name}.{i}": wide for name in "abcdef" for i in "XYZR"})
    yield Upload("2048 squared zeros, 24 float channels", stream.getvalue())
    yield Upload("65,536 x 65,536 in a header", image(header(dataWindow=box(0, 0, 65_535, 65_535))))


def contents() -> Iterator[Upload]:
    nan = np.full((8, 8), np.nan, np.float32)
    for name, names in {
        "no position": CHANNELS[:3],
        "no normal and no position": ("A",),
        "half a position": (*CHANNELS[:3], "position.X"),
        "colours only": ("R", "G", "B"),
        "names of another language": ("法線.X", "法線.Y"),
        "empty layer names": (".X", ".Y", ".Z"),
        "spaces": ("  ", "   "),
        "65 wrong channels": tuple(f"x{i}" for i in range(65)),
    }.items():
        yield Upload(name, good(8, 8, names=names))
    stream = io.BytesIO()
    exr.write(stream, {"Z": nan})
    yield Upload("NaN depth without a camera", stream.getvalue())
    exr.write(stream := io.BytesIO(), {"Z": nan + 1}, attributes={"deepshade:fov": -50.0})
    yield Upload("a negative field of view", stream.getvalue())
    exr.write(stream := io.BytesIO(), {"Z": nan + 1}, attributes={"deepshade:fov": np.nan})
    yield Upload("a field of view that is no number", stream.getvalue())
    for radius in (0.0, -1.0, np.nan, np.inf, 1e-38, "big"):
        body = good(8, 8, attributes={"deepshade:radius": radius})
        yield Upload(f"header radius {radius}", body)
    yield Upload("over the body limit", bytes(9 * 2**20))
    yield Upload("an EXR over the body limit", good() + bytes(9 * 2**20))
    for query in (
        "radius=0",
        "radius=nan",
        "radius=1e400",
        "fov=180",
        "map=a",
        "map=depth=x",
        "x=1",
    ):
        yield Upload(f"?{query}", good(8, 8), query=f"?{query}")


def others() -> Iterator[Upload]:
    """What isn't EXR at all, and what isn't said to be."""
    rng = np.random.default_rng(1)
    yield Upload("nothing", b"")
    yield Upload("text", b"this is no picture\n" * 100)
    yield Upload("HTML", b"<!doctype html><script>alert(1)</script>")
    yield Upload("JSON", b'{"a": [' + b"[" * 10_000)
    yield Upload("PNG", b"\x89PNG\r\n\x1a\n" + rng.bytes(500))
    yield Upload("JPEG", b"\xff\xd8\xff\xe0" + rng.bytes(500))
    yield Upload("TIFF", b"II*\0" + rng.bytes(500))
    yield Upload("gzip", b"\x1f\x8b\x08" + rng.bytes(500))
    yield Upload("ZIP", b"PK\3\4" + rng.bytes(500))
    yield Upload("a byte", b"v")
    yield Upload("the magic alone", MAGIC)
    yield Upload("the magic backwards", MAGIC[::-1] + good()[4:])
    yield Upload("an EXR with a byte before it", b"\0" + good())
    for seed in range(6):
        yield Upload(f"noise {seed}", np.random.default_rng(seed).bytes(5000))
        yield Upload(f"noise {seed} after the magic", MAGIC + b"\2\0\0\0" + rng.bytes(3000))
    for kind in (
        "text/plain",
        "image/png",
        "application/x-www-form-urlencoded",
        "x" * 500,
        "image/x-exr/x",
        ";;;",
        "multipart/mixed; boundary=X",
        "multipart/form-data",
        "multipart/form-data; boundary=",
        "multipart/form-data; boundary=" + "b" * 500,
    ):
        yield Upload(f"as {kind[:40]}", good(8, 8), kind=kind)


def forms() -> Iterator[Upload]:
    def part(data: bytes, head: bytes = b'form-data; name="a"; filename="a.exr"') -> bytes:
        return b"--X\r\nContent-Disposition: " + head + b"\r\n\r\n" + data + b"\r\n"

    end = b"--X--\r\n"
    body = good(8, 8)
    cases = {
        "another boundary": part(body).replace(b"--X", b"--Y") + end,
        "no end": part(body),
        "half an end": part(body) + b"--X-",
        "no files": end,
        "an empty file": part(b"") + end,
        "text": part(b"hello") + end,
        "cut within the file": (part(body) + end)[: len(body) // 2],
        "a truncated EXR": part(body[:-50]) + end,
        "a good and a truncated EXR": part(body) + part(body[:-50]) + end,
        "the same EXR twice": part(body) + part(body) + end,
        "a field": part(b"1", b'form-data; name="radius"') + end,
        "no name": part(body, b"form-data") + end,
        "no disposition": b"--X\r\n\r\n" + body + b"\r\n" + end,
        "a header of 1 MB": part(body, b"x" * 10**6) + end,
        "a thousand headers": b"--X\r\n" + b"A: b\r\n" * 1000 + b"\r\n" + body + b"\r\n" + end,
        "a thousand files": part(b"x") * 1000 + end,
        "no line breaks": part(body).replace(b"\r\n", b"") + end,
        "over the limit": part(bytes(9 * 2**20)) + end,
    }
    for name, data in cases.items():
        yield Upload(f"form: {name}", data, kind="multipart/form-data; boundary=X")


def many_names() -> Iterator[Upload]:
    """What only the usual limits let through: very many channels, attributes, parts."""
    letters = np.array(list("positnrmal_."))
    rng = np.random.default_rng(0)
    names = ["".join(rng.choice(letters, 245)) + f"x{n}" for n in range(1024)]
    yield Upload("1,024 channels with long names", good(1, 1, names=names, dtype=np.float32))
    tiny = b"".join(attribute(b"a%d" % n, b"int", bytes(4)) for n in range(19_000))
    named = (
        attribute(b"name", b"string", b"p%d" % i)
        + attribute(b"type", b"string", b"scanlineimage")
        + attribute(b"chunkCount", b"int", struct.pack("<i", 2))
        + tiny
        + header()
        for i in range(64)
    )
    flags = struct.pack("<I", 2 | 0x1000)
    yield Upload("64 x 19,000 attributes", MAGIC + flags + b"".join(named) + b"\0" + bytes(1024))
    texts = attribute(b"x", b"stringvector", bytes(4 * 5_000_000))
    yield Upload("5,000,000 empty texts", image(texts + header()))


GROUPS = (
    truncations,
    flips,
    windows,
    headers,
    chunks,
    multipart_files,
    bombs,
    contents,
    others,
    forms,
)


@pytest.mark.slow
def test_hostile_uploads_at_the_usual_limits(start):
    local = start()
    for upload in many_names():
        response = local.client.post(
            "/shade/ao", content=upload.body, headers={"Content-Type": upload.kind}
        )
        assert 400 <= response.status_code < 500, upload.name


@pytest.mark.slow
def test_hostile_uploads(start_server, make_exr):
    options = [piece for option in LIMITS.items() for piece in option]
    server = start_server(*options, "--memory", "1G", "--log-level", "critical")
    uploads = [upload for group in GROUPS for upload in group()]
    assert len(uploads) >= 200
    assert len({upload.name for upload in uploads}) == len(uploads)

    wrong = []
    with httpx.Client(base_url=server.url, trust_env=False, timeout=30) as client:

        def shade(upload: Upload) -> httpx.Response:
            return client.post(
                f"/shade/ao{upload.query}",
                content=upload.body,
                headers={"Content-Type": upload.kind},
            )

        fine = Upload("good", make_exr(512, 768, half=True))
        for _ in range(4):
            assert shade(fine).status_code == 200
        for upload in uploads[::10]:
            shade(upload)
        time.sleep(2.5)  # until the idle service has handed its memory back
        before = server.resident

        for upload in uploads:
            response = shade(upload)
            kind = response.headers.get("content-type")
            if not (400 <= response.status_code < 500) or kind != "application/problem+json":
                wrong.append(f"{upload.name}: {response.status_code} {kind} {response.text[:200]}")
            elif not response.json()["detail"]:
                wrong.append(f"{upload.name}: no detail")
        assert not wrong, "\n".join(wrong)

        assert shade(fine).status_code == 200
        time.sleep(2.5)
        after = server.resident
    assert after < 1.2 * before, f"{before / 2**20:.0f} MiB before, {after / 2**20:.0f} MiB after"
