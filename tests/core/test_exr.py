"""Reading and writing: every kind of file that people send, against the OpenEXR library itself."""

import io
import os
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deepshade import exr
from deepshade.errors import DamagedImageError, ImageError, LimitError
from deepshade.exr import Limits
from deepshade.exr import chunks as exrchunks
from deepshade.exr import decode as exrdecode
from deepshade.exr import header as exrheader
from deepshade.threads import thread_count

SHARED = Path(__file__).resolve().parents[3] / "shared" / "exr"
LOSSLESS = ("none", "rle", "zips", "zip", "piz", "htj2k256")


def plane(height=20, width=33, seed=0):
    return np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)


def encode(channels, **settings):
    body = io.BytesIO()
    exr.write(body, channels, **settings)
    return body.getvalue()


def by_openexr(parts):
    body = io.BytesIO()
    OpenEXR.File(parts).write(body)
    return body.getvalue()


def window(x0, y0, x1, y1):
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def test_attributes_are_counted_over_all_parts():
    """Each part has fewer than a file may have; together they have more."""
    many = {f"a{n}": 1 for n in range(2500)}
    made = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage, **many}, {"Z": plane(1, 1)}, name)
        for name in ("one", "two")
    ]
    assert len(exr.read_header(by_openexr(made[:1])).parts[0].attributes) > 2500
    with pytest.raises(ImageError, match="over 4,000 attributes"):
        exr.read_header(by_openexr(made))


def test_texts_in_one_attribute_are_counted():
    body = encode({"Z": plane(1, 1)})
    texts = b"x\0stringvector\0" + struct.pack("<i", 4 * 5000) + bytes(4 * 5000)
    with pytest.raises(DamagedImageError, match="stringvector"):
        exr.read_header(body[:8] + texts + body[8:])


@pytest.mark.parametrize("compression", LOSSLESS)
@pytest.mark.parametrize("half", [False, True, ["b"]])
def test_round_trip(compression, half):
    stored = {"a": plane(), "layer.b": plane(seed=1), "b": plane(seed=2)}
    image = exr.read(encode(stored, compression=compression, half=half))
    for name, values in stored.items():
        is_half = half if isinstance(half, bool) else name in half
        expected = values.astype(np.float16).astype(np.float32) if is_half else values
        np.testing.assert_array_equal(image.pixels[name], expected)
        assert image.pixels[name].dtype == np.float32
        assert image.pixels[name].flags.c_contiguous
        assert image.header.parts[0].channels[name] == ("half" if is_half else "float")


@pytest.mark.parametrize("version", [(3, 4, 13), (3, 3, 99)])
@pytest.mark.parametrize("code", ["HTJ2K256", "HTJ2K32"])
def test_htj2k_is_read_only_by_a_library_without_its_bugs(version, code, monkeypatch):
    header = {"type": OpenEXR.scanlineimage, "compression": getattr(OpenEXR, f"{code}_COMPRESSION")}
    body = by_openexr([OpenEXR.Part(header, {"Y": plane().astype(np.float16)}, "")])
    assert exrheader.LIBRARY_VERSION >= (3, 5)
    for enough in (exrheader.LIBRARY_VERSION, (3, 4, 14), (4, 0, 0)):
        monkeypatch.setattr(exrheader, "LIBRARY_VERSION", enough)
        np.testing.assert_array_equal(exr.read(body).pixels["Y"], plane().astype(np.float16))
    monkeypatch.setattr(exrheader, "LIBRARY_VERSION", version)
    with pytest.raises(ImageError, match=r"htj2k.* can't be read safely") as caught:
        exr.read_header(body)
    assert "3.4.14" in caught.value.fix


@pytest.mark.parametrize("compression", ["pxr24", "b44", "b44a", "dwaa", "dwab"])
def test_lossy_compressions_come_close(compression):
    smooth = np.add.outer(np.linspace(0, 1, 40), np.linspace(0, 1, 50)).astype(np.float32)
    image = exr.read(encode({"Y": smooth}, compression=compression, half=True))
    np.testing.assert_allclose(image.pixels["Y"], smooth, atol=0.03)


def test_strided_arrays_are_written_right():
    # OpenEXR issue 1929: given strides, the library writes other pixels without an error
    whole = np.arange(60 * 80 * 3, dtype=np.float32).reshape(60, 80, 3)
    views = {"c": whole[..., 1], "t": whole[..., 0].T[:60, :60], "r": whole[::-1, ::2, 2]}
    for view in views.values():
        assert not view.flags.c_contiguous
        image = exr.read(encode({"Y": view}))
        np.testing.assert_array_equal(image.pixels["Y"], view)


def test_half_saturates_and_keeps_infinities():
    values = np.array([[1e9, -1e9, np.inf, -np.inf, np.nan, 1e-30]], np.float32)
    back = exr.read(encode({"Y": values}, half=True)).pixels["Y"][0]
    np.testing.assert_array_equal(back, [65504, -65504, np.inf, -np.inf, np.nan, 0])


def test_uint_is_read_as_float():
    body = by_openexr([OpenEXR.Part({}, {"id": np.arange(12, dtype=np.uint32).reshape(3, 4)})])
    image = exr.read(body)
    np.testing.assert_array_equal(image.pixels["id"], np.arange(12).reshape(3, 4))
    assert image.header.parts[0].channels == {"id": "uint"}


@pytest.mark.parametrize("origin", [(0, 0), (-7, 3), (500, -500)])
def test_data_window_and_frame(origin):
    data, display = (*origin, origin[0] + 5, origin[1] + 4), (-9, 5, 90, 54)
    body = encode({"Y": plane(5, 6)}, data_window=data, display_window=display)
    part = exr.read_header(body).parts[0]
    assert part.data_window == data
    assert part.display_window == display
    with OpenEXR.File(io.BytesIO(body)) as file:
        assert tuple(np.ravel(file.header()["displayWindow"])) == display
    assert part.shape == (5, 6)
    np.testing.assert_array_equal(exr.read(body).pixels["Y"], plane(5, 6))


def test_attributes_agree_with_the_library():
    attributes = {
        "text": "hä",
        "count": 3,
        "big": 2**40,
        "ratio": 1.5,
        "flag": True,
        "pair": (1, 2),
        "vector": (1.0, 2.0, 3.5),
        "m33": np.arange(9.0).reshape(3, 3),
        "m44": np.arange(16.0).reshape(4, 4),
    }
    body = encode({"Y": plane()}, attributes=attributes)
    ours = exr.read_header(body).parts[0].attributes
    with OpenEXR.File(io.BytesIO(body), separate_channels=True) as file:
        theirs = dict(file.header())
    for key, value in attributes.items():
        expected = str(value) if key == "big" else value
        np.testing.assert_array_equal(ours[key], expected)
        np.testing.assert_array_equal(theirs[key], expected)


@pytest.mark.parametrize("value", [None, b"x", (1, 2, 3, 4, 5), {"a": 1}, np.zeros((2, 5))])
def test_refuses_attributes_that_no_header_holds(value):
    with pytest.raises(ValueError, match="'key'"):
        encode({"Y": plane()}, attributes={"key": value})


@pytest.mark.parametrize(
    "channels",
    [
        {},
        {"Y": np.zeros((0, 4))},
        {"Y": np.zeros(4)},
        {"Y": np.zeros((2, 2), complex)},
        {"Y": np.zeros((2, 2)), "Z": np.zeros((2, 3))},
    ],
)
def test_refuses_arrays_that_are_no_image(channels):
    with pytest.raises(ValueError, match=r"channel|size"):
        encode(channels)


def test_one_pixel():
    assert exr.read(encode({"Y": np.full((1, 1), 2.0)})).pixels["Y"][0, 0] == 2


def tiles(width, height, mode=OpenEXR.LevelMode.ONE_LEVEL):
    description = OpenEXR.TileDescription()
    description.xSize, description.ySize, description.mode = width, height, mode
    return description


def multipart():
    frame = {"type": OpenEXR.scanlineimage, "displayWindow": window(0, 0, 32, 19)}
    return by_openexr(
        [
            OpenEXR.Part(dict(frame), {"X": plane(), "Z": plane(seed=1)}, "n"),
            OpenEXR.Part(dict(frame), {"X": plane(7, 9), "Q": plane(7, 9)}, "p"),
        ]
    )


def test_multipart_names_are_qualified_only_when_they_clash():
    image = exr.read(multipart())
    assert set(image.pixels) == {"n:X", "Z", "p:X", "Q"}
    np.testing.assert_array_equal(image.pixels["n:X"], plane())
    np.testing.assert_array_equal(image.pixels["p:X"], plane(7, 9))
    assert [part.name for part in image.header.parts] == ["n", "p"]


def test_selection_orders_the_memory():
    body = encode({name: plane(seed=i) for i, name in enumerate("abcd")})
    image = exr.read(body, ["c", "a", "b"])
    assert list(image.pixels) == ["c", "a", "b"]
    stacked = image.stack(["a", "b"])
    assert np.shares_memory(stacked, image.pixels["a"])
    assert stacked.flags.c_contiguous
    np.testing.assert_array_equal(stacked, np.stack([plane(seed=0), plane(seed=1)]))
    other = image.stack(["b", "c"])
    np.testing.assert_array_equal(other, np.stack([plane(seed=1), plane(seed=2)]))
    with pytest.raises(ImageError, match="no channel 'x'"):
        exr.read(body, ["x"])


@pytest.mark.parametrize("size", [(16, 16), (64, 8), (100, 100)])
def test_tiled_files(size):
    header = {"type": OpenEXR.tiledimage, "tiles": tiles(*size)}
    header["compression"] = OpenEXR.ZIP_COMPRESSION
    body = io.BytesIO()
    OpenEXR.File(header, {"Y": plane(50, 70)}).write(body)
    image = exr.read(body.getvalue())
    assert image.header.parts[0].tiled
    np.testing.assert_array_equal(image.pixels["Y"], plane(50, 70))


def test_subsampled_channels_are_refused_by_name():
    body = bytearray(encode({"BY": plane(8, 8), "Y": plane(8, 8)}))
    at = body.index(b"BY\0") + 3 + 8  # behind the pixel type and the flags
    struct.pack_into("<2i", body, at, 2, 2)
    assert exr.read_header(bytes(body)).parts[0].subsampled == {"BY"}
    with pytest.raises(ImageError, match="'BY' is subsampled"):
        exr.read(bytes(body))


def test_paths_are_replaced_atomically(tmp_path):
    path = tmp_path / "out.exr"
    exr.write(path, {"Y": plane()})
    before = path.read_bytes()
    with pytest.raises(ValueError, match="differ"):
        exr.write(path, {"Y": plane(), "Z": plane(3, 3)})
    assert path.read_bytes() == before
    exr.write(path, {"Y": plane(seed=3)})
    np.testing.assert_array_equal(exr.read(path).pixels["Y"], plane(seed=3))
    np.testing.assert_array_equal(exr.read(str(path)).pixels["Y"], plane(seed=3))
    assert [p.name for p in tmp_path.iterdir()] == ["out.exr"]


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(ImageError, match="No such file"):
        exr.read(tmp_path / "none.exr")
    with pytest.raises(ImageError, match="directory"):
        exr.read(tmp_path)


@pytest.mark.parametrize("body", [b"", b"v/1", b"\x89PNG\r\n", b"GIF89a" * 100, b"\0" * 64])
def test_other_files_are_no_exr(body):
    with pytest.raises(ImageError) as caught:
        exr.read_header(body)
    assert not isinstance(caught.value, DamagedImageError)


@pytest.mark.parametrize("compression", ["none", "zip", "piz"])
def test_every_truncation_is_noticed_before_decoding(compression):
    body = encode({"Y": plane(40, 20)}, compression=compression)
    for end in range(8, len(body)):
        with pytest.raises(DamagedImageError):
            exr.read_header(body[:end])


def test_unwritten_chunks_are_noticed():
    body = bytearray(encode({"Y": plane(40, 20)}))
    # three chunks of 16 lines; their table is what stands before the first chunk
    first = body.index(struct.pack("<i", 0), len(body) // 20)
    table = next(
        at
        for at in range(len(body) - 24)
        if struct.unpack_from("<Q", body, at)[0] == at + 24  # points right behind itself
    )
    assert first
    struct.pack_into("<Q", body, table + 8, 0)
    with pytest.raises(DamagedImageError, match="1 of 3 chunks"):
        exr.read_header(bytes(body))


def test_pixels_that_cannot_be_decompressed_are_named_by_their_scanlines():
    body = bytearray(encode({"Y": np.zeros((40, 20))}, compression="zip"))
    body[-8:] = bytes(8)
    with pytest.raises(DamagedImageError, match=r"damaged within scanlines \d+ to 39") as caught:
        exr.read(bytes(body))
    assert caught.value.fix


def patched(name, kind, value, **settings):
    """A valid file with one header value overwritten."""
    body = bytearray(encode({"Y": plane()}, **settings))
    mark = name.encode() + b"\0" + kind.encode() + b"\0"
    at = body.index(mark) + len(mark) + 4
    body[at : at + len(value)] = value
    return bytes(body)


@pytest.mark.parametrize(
    ("name", "kind", "value", "error"),
    [
        ("dataWindow", "box2i", struct.pack("<4i", 0, 0, 2**31 - 1, 2**31 - 1), DamagedImageError),
        ("dataWindow", "box2i", struct.pack("<4i", 0, 0, 10**5, 10**5), LimitError),
        ("dataWindow", "box2i", struct.pack("<4i", -(2**31), 0, 2**31 - 1, 0), DamagedImageError),
        ("dataWindow", "box2i", struct.pack("<4i", 5, 5, 4, 4), DamagedImageError),
        ("dataWindow", "box2i", struct.pack("<4i", 0, 0, 32, 10**6), DamagedImageError),
        ("displayWindow", "box2i", struct.pack("<4i", 0, 0, -1, -1), DamagedImageError),
        (
            "displayWindow",
            "box2i",
            struct.pack("<4i", *[-(2**30)] * 2, *[2**30] * 2),
            DamagedImageError,
        ),
        ("compression", "compression", b"\xfe", ImageError),
        ("channels", "chlist", b"Y\0" + struct.pack("<i", 99), DamagedImageError),
    ],
)
def test_absurd_headers(name, kind, value, error):
    with pytest.raises(error):
        exr.read(patched(name, kind, value))


def test_version_flags():
    body = bytearray(encode({"Y": plane()}))
    for flags, reason in ((0x800, "deep"), (0x10000, "unknown"), (0x1000, "."), (0x200, "type")):
        changed = bytearray(body)
        struct.pack_into("<I", changed, 4, 2 | flags)
        with pytest.raises(ImageError, match=reason):
            exr.read(bytes(changed))


def test_limits_hold_before_decoding():
    body = encode({"a": plane(64, 64), "b": plane(64, 64)})
    for name, value in (
        ("pixels", 64 * 64),
        ("channels", 2),
        ("decoded_bytes", 64 * 64 * 8),
        ("body_bytes", len(body)),
    ):
        exr.read_header(body, Limits(**{name: value}))
        with pytest.raises(LimitError) as caught:
            exr.read_header(body, Limits(**{name: value - 1}))
        assert (caught.value.limit, caught.value.value) == (name, value)
        assert caught.value.maximum == value - 1
    with pytest.raises(LimitError, match="parts"):
        exr.read_header(multipart(), Limits(parts=1))


def test_a_bomb_is_refused_by_its_decoded_size():
    body = encode({name: np.zeros((2048, 2048), np.float32) for name in "ab"})
    assert len(body) < 200_000
    with pytest.raises(LimitError, match="decoded bytes"):
        exr.read(body, limits=Limits(decoded_bytes=16 << 20))


def test_long_chunk_tables_are_checked_in_blocks(monkeypatch):
    monkeypatch.setattr(exrchunks, "_TABLE_BLOCK", 7)
    body = encode({"Y": plane(40, 3)}, compression="none")
    np.testing.assert_array_equal(exr.read(body).pixels["Y"], plane(40, 3))
    for end in range(len(body) - 40, len(body)):
        with pytest.raises(DamagedImageError):
            exr.read_header(body[:end])


def test_damaged_pixels():
    body = bytearray(encode({"Y": plane(64, 64).round()}))
    body[-400:-200] = os.urandom(200)
    with pytest.raises(DamagedImageError):
        exr.read(bytes(body))


@pytest.fixture
def small_strips(monkeypatch):
    """As if images were too large to be decoded at once."""
    monkeypatch.setattr(exrdecode, "MIN_STRIP", 500)
    monkeypatch.setattr(exrdecode, "MAX_STRIP", 1000)


def by_library(body):
    """Every part's channels as the library decodes them, converted by numpy."""
    with OpenEXR.File(io.BytesIO(body), separate_channels=True) as file:
        return [
            {name: channel.pixels.astype(np.float32) for name, channel in part.channels.items()}
            for part in file.parts
        ]


@pytest.mark.parametrize("compression", exr.COMPRESSIONS)
def test_strips_give_what_the_whole_gives(compression, small_strips):
    planes = {"a": plane(300, 9), "layer.b": plane(300, 9, 1), "c": plane(300, 9, 2)}
    body = encode(planes, compression=compression, half=["a", "c"], data_window=(-4, -7, 4, 292))
    image, (expected,) = exr.read(body), by_library(body)
    for name, values in expected.items():
        np.testing.assert_array_equal(image.pixels[name], values)


@pytest.mark.parametrize("compression", ["NO", "ZIP", "PIZ"])
def test_parts_of_all_kinds_are_read_alone(compression, small_strips):
    header = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "owner": "x" * 5000}
    header["displayWindow"] = window(0, 0, 99, 99)
    tiled = {"type": OpenEXR.tiledimage, "tiles": tiles(16, 16)}
    lines = {"type": OpenEXR.scanlineimage}
    halves = {name: plane(77, 40, seed).astype(np.float16) for seed, name in enumerate("XYZ")}
    made = [
        OpenEXR.Part({**lines, **header}, {"Q": plane(50, 41)}, "q"),
        OpenEXR.Part({**lines, **header}, halves, "n"),
        OpenEXR.Part(
            {**lines, **header, "lineOrder": OpenEXR.DECREASING_Y},
            {"id": np.arange(77 * 40, dtype=np.uint32).reshape(77, 40), "Z": plane(77, 40, 9)},
            "d",
        ),
        OpenEXR.Part({**tiled, **header}, {"T": plane(33, 50)}, "t"),
    ]
    body = by_openexr(made)
    expected = by_library(body)
    places = exr.read_header(body).channels()
    for name, (part, channel) in places.items():
        image = exr.read(body, [name])
        assert list(image.pixels) == [name]
        np.testing.assert_array_equal(image.pixels[name], expected[part][channel])
    everything = exr.read(body)
    for name, (part, channel) in places.items():
        np.testing.assert_array_equal(everything.pixels[name], expected[part][channel])


def test_parts_without_wanted_channels_are_not_decoded():
    body = bytearray(multipart())
    start = exr.read_header(bytes(body)).parts[1].chunks.table(memoryview(body)).min()
    body[int(start) + 12 :] = bytes(len(body) - int(start) - 12)  # the pixels of "p", the last
    exr.read(bytes(body), ["n:X"])
    with pytest.raises(DamagedImageError):
        exr.read(bytes(body), ["p:X"])


def test_unwanted_channels_are_there_only_strip_by_strip(monkeypatch):
    monkeypatch.setattr(exrdecode, "MAX_STRIP", 2**20)
    size = 512 * 512 * 4
    body = encode({f"c{n:02}": plane(512, 512) for n in range(24)}, compression="none", half=True)
    for compressed in (body, encode(exr.read(body).pixels, compression="zip", half=True)):
        header = exr.read_header(compressed)
        tracemalloc.start()
        exr.read(compressed, ["c07"], header=header)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        # the plane itself, and for each thread a strip: cut out, and decoded
        assert peak < size + thread_count() * 4 * 2**20 < 12 * size


def test_what_is_not_finite_is_named():
    planes = {name: plane() for name in "abcd"}
    planes["b"][3, 4], planes["d"][0, 0], planes["a"][1, 1] = np.nan, -np.inf, 1e30
    for settings in ({}, {"half": True}, {"compression": "none"}):
        assert exr.read(encode(planes, **settings)).nonfinite == {"b", "d"}
    assert exr.read(encode(planes), ["a", "c"]).nonfinite == frozenset()


def test_tiles_in_the_wrong_place_are_refused():
    header = {"type": OpenEXR.tiledimage, "tiles": tiles(16, 16)}
    body = bytearray(by_openexr([OpenEXR.Part(header, {"Y": plane(40, 40)}, "")]))
    first = int(exr.read_header(bytes(body)).parts[0].chunks.table(memoryview(bytes(body)))[0])
    struct.pack_into("<2i", body, first, 1, 1)
    with pytest.raises(DamagedImageError, match="another tile"):
        exr.read(bytes(body))


@pytest.fixture
def decoded(monkeypatch):
    """The rows of chunks that were decoded, as they come."""
    rows = []
    cut = exrchunks.Chunks.cut

    def count(chunks, data, some):
        rows.extend(some)
        return cut(chunks, data, some)

    monkeypatch.setattr(exrchunks.Chunks, "cut", count)
    return rows


def with_repeats(pattern, height, width=300, lines=16):
    """A picture in which the bands of one letter are alike; only "." is like no other."""
    rng = np.random.default_rng(0)
    bands = {letter: rng.normal(size=(lines, width)) for letter in sorted(set(pattern))}
    rows = [rng.normal(size=(lines, width)) if c == "." else bands[c] for c in pattern]
    return np.concatenate(rows)[:height].astype(np.float16)


@pytest.mark.parametrize("strip", [2**13, 2**15, 2**20])
@pytest.mark.parametrize("compression", ["zip", "piz", "zips"])
@pytest.mark.parametrize("pattern", ["a", "aaaa", "ab.ba.aab", "a.a.a.a", "...."])
@pytest.mark.parametrize("missing", [0, 7])
def test_repeated_chunks_are_decoded_once(
    pattern, missing, compression, strip, decoded, monkeypatch
):
    monkeypatch.setattr(exrdecode, "MIN_STRIP", strip)
    monkeypatch.setattr(exrdecode, "MAX_STRIP", strip)
    lines = {"zip": 16, "piz": 32, "zips": 1}[compression]
    missing = min(missing, lines - 1)  # scanlines of the last band: that one is like no other
    plane = with_repeats(pattern, len(pattern) * lines - missing, lines=lines)
    window = 5, -9, 4 + plane.shape[1], len(plane) - 10
    body = encode({"Y": plane, "Z": -plane}, half=True, compression=compression, data_window=window)
    image = exr.read(body)
    np.testing.assert_array_equal(image.pixels["Y"], plane)
    np.testing.assert_array_equal(image.pixels["Z"], -plane)
    np.testing.assert_array_equal(exr.read(body, ["Z"]).pixels["Z"], -plane)
    whole = pattern[:-1] if missing else pattern
    distinct = len(set(whole) - {"."}) + whole.count(".") + (missing > 0)
    assert len(decoded) == 2 * len(set(decoded)) == 2 * distinct


def test_repeated_chunks_of_parts_in_any_order(decoded):
    """Chunks of two parts, stored from the last to the first, are alike only within a part."""
    header = {"type": OpenEXR.scanlineimage, "lineOrder": OpenEXR.DECREASING_Y}
    header["compression"] = OpenEXR.ZIP_COMPRESSION
    planes = {"X": with_repeats("abbaa", 75, 600), "Y": with_repeats("aaaaa", 75, 600)}
    parts = [OpenEXR.Part(dict(header), {name: p.copy()}, name) for name, p in planes.items()]
    image = exr.read(by_openexr(parts))
    for name, plane in planes.items():
        np.testing.assert_array_equal(image.pixels[name], plane)
    assert len(decoded) == 3 + 2


def test_repeated_chunks_keep_what_is_not_finite(decoded):
    plane = with_repeats("abab", 64)
    plane[20, 3] = plane[52, 3] = np.nan
    image = exr.read(encode({"Y": plane, "Z": with_repeats("abab", 64)}, half=True))
    np.testing.assert_array_equal(image.pixels["Y"], plane)
    assert image.nonfinite == {"Y"}
    assert decoded == [0, 1]


def test_chunks_that_differ_in_one_byte_are_both_decoded(decoded):
    body = encode({"Y": np.zeros((48, 300), np.float32)})
    chunks = exr.read_header(body).parts[0].chunks
    (first, size), (second, _), _ = chunks.places(memoryview(body), 0, 3)
    changed = bytearray(body)
    changed[second : second + size] = changed[first : first + size]
    changed[second + 2] ^= 0x40  # what the checksum behind it says no longer holds
    with pytest.raises(DamagedImageError):
        exr.read(bytes(changed))
    assert decoded == [0, 1]


def test_overlapping_chunks_are_refused():
    """Cut apart, they would be larger than the file they came in."""
    body = bytearray(encode({"Y": plane(200, 40)}, compression="zips"))
    chunks = exr.read_header(bytes(body)).parts[0].chunks
    for offset in chunks.table(memoryview(bytes(body))).tolist():
        struct.pack_into("<i", body, offset + 4, len(body) - offset - 8)
    with pytest.raises(DamagedImageError, match="overlap"):
        exr.read(bytes(body))


def test_reading_in_a_forked_child_does_not_hang():
    body = encode({"Y": plane(64, 64)})
    exr.read(body)  # starts the thread pool, which the child doesn't get
    pid = os.fork()
    if pid == 0:
        try:
            os._exit(0 if exr.read(body).pixels["Y"].shape == (64, 64) else 1)
        except BaseException:
            os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


FILES = [
    # the largest decodes to 300 MB
    pytest.param(path, marks=pytest.mark.slow if path.stat().st_size > 500_000 else ())
    for path in sorted(SHARED.glob("*/*.exr"))
]


@pytest.mark.skipif(not FILES, reason="the shared EXR files are not beside the repository")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_real_files_read_as_the_library_reads_them(path):
    header = exr.read_header(path)
    wanted = list(header.channels())[:4]
    image = exr.read(path, wanted)
    with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
        part, ours = file.parts[0], header.parts[0]
        assert ours.channels.keys() == part.channels.keys()
        low, high = part.header["dataWindow"]
        assert ours.data_window == (*low, *high)
        for key, value in part.header.items():
            if isinstance(value, (int, float, str)) and key in ours.attributes:
                assert ours.attributes[key] == value
        for name in wanted:
            np.testing.assert_array_equal(image.pixels[name], part.channels[name].pixels)
