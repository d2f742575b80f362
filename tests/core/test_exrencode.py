"""What our own encoder writes, against what the OpenEXR library reads and writes."""

import io
import struct
import tracemalloc

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepshade import exr
from deepshade.exr import encode as exrencode
from deepshade.exr.attributes import Cursor, read_part
from deepshade.threads import thread_count

LIBRARY = {"zip": OpenEXR.ZIP_COMPRESSION, "zips": OpenEXR.ZIPS_COMPRESSION}
SPECIAL = np.array([0, -0.0, 1, -1, 1e-7, 65504, np.inf, -np.inf, np.nan], np.float32)
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), min_size=1)


def encode(channels, **settings):
    stream = io.BytesIO()
    exr.write(stream, channels, **settings)
    return stream.getvalue()


def by_library(body):
    with OpenEXR.File(io.BytesIO(body), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.parts[0].channels.items()}


def picture(kind, height, width, seed=0):
    rng = np.random.default_rng(seed)
    if kind == "noise":  # every bit pattern but NaN's
        bits = rng.integers(0, 2**32, (height, width), np.uint32)
        return np.nan_to_num(bits.view(np.float32))
    if kind == "special":
        return rng.choice(SPECIAL, (height, width))
    if kind == "constant":
        return np.full((height, width), 0.75, np.float32)
    return np.add.outer(np.sin(np.arange(height) / 9), np.arange(width) / 7).astype(np.float32)


@st.composite
def images(draw):
    size = draw(st.integers(1, 40)), draw(st.integers(1, 30))
    names = draw(st.sets(NAMES.filter(lambda n: len(n.encode()) < 256), min_size=1, max_size=4))
    kinds = st.sampled_from(["noise", "special", "constant", "smooth"])
    planes = {name: picture(draw(kinds), *size, seed) for seed, name in enumerate(names)}
    return planes, draw(st.sets(st.sampled_from(sorted(names))))


@settings(max_examples=60, deadline=None)
@given(images(), st.sampled_from(["zip", "zips"]), st.integers(-50, 50), st.integers(1, 3000))
def test_the_library_reads_what_we_write(image, compression, top, strip):
    planes, half = image
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exrencode, "MIN_STRIP", strip)
        patch.setattr(exrencode, "MAX_STRIP", strip)
        height, width = next(iter(planes.values())).shape
        window = 3, top, 2 + width, top + height - 1
        body = encode(planes, half=half, compression=compression, data_window=window)
    found, ours = by_library(body), exr.read(body).pixels
    assert found.keys() == planes.keys() == ours.keys()
    for name, plane in planes.items():
        if name in half:
            with np.errstate(over="ignore"):
                limited = np.where(np.isinf(plane), plane, np.clip(plane, -65504, 65504))
                plane = limited.astype(np.float16)
        assert found[name].dtype == plane.dtype
        assert found[name].tobytes() == plane.tobytes()
        np.testing.assert_array_equal(ours[name], plane)


ATTRIBUTES = {
    "text": "hä",
    "empty": "",
    "count": -3,
    "ratio": 1.5,
    "far": float("inf"),
    "pair": (1, 2),
    "triple": (1, -2, 3),
    "place": (0.5, 2.0),
    "vector": (1.0, 2.0, 3.5),
    "m33": np.arange(9.0).reshape(3, 3),
    "m44": np.arange(16.0).reshape(4, 4),
    "pixelAspectRatio": 2.0,
    "screenWindowCenter": (1.0, -1.0),
    "a name of more than 31 bytes, which sets a flag": 1,
}


@pytest.mark.parametrize("names", [[], list(ATTRIBUTES)[:-1], list(ATTRIBUTES)])
def test_headers_are_those_of_the_library(names):
    planes = {name: picture("smooth", 20, 9) for name in ("b", "B", "a.X", "ä")}
    attributes = {name: ATTRIBUTES[name] for name in names}
    windows = {"data_window": (-4, 7, 4, 26), "display_window": (0, 0, 49, 59)}
    ours = encode(planes, attributes=attributes, **windows)
    arrays = {
        name: np.asarray(value, np.int32 if isinstance(value[0], int) else np.float32)
        for name, value in attributes.items()
        if isinstance(value, (tuple, np.ndarray))
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["dataWindow"] = np.array([-4, 7], np.int32), np.array([4, 26], np.int32)
    header["displayWindow"] = np.array([0, 0], np.int32), np.array([49, 59], np.int32)
    stream = io.BytesIO()
    with OpenEXR.File(attributes | arrays | header, planes) as file:
        file.write(stream)
    theirs = stream.getvalue()
    assert ours[:8] == theirs[:8]  # magic number, version, flags
    found, expected = (
        read_part(Cursor(memoryview(body), 8), exr.Limits(), 100) for body in (ours, theirs)
    )
    assert found.types == expected.types
    assert found.values == expected.values


@pytest.mark.parametrize("name", ["x" * 31, "x" * 32, "x" * 255])
def test_long_names(name):
    body = encode({name: picture("smooth", 2, 2)})
    assert by_library(body).keys() == {name}
    assert bool(body[5] & 4) == (len(name) > 31)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"attributes": {"": 1}}, "1 to 255"),
        ({"attributes": {"x" * 256: 1}}, "1 to 255"),
        ({"attributes": {"a\0b": 1}}, "1 to 255"),
        ({"attributes": {"channels": "Y"}}, "'channels' can't be chosen"),
        ({"attributes": {"lineOrder": 1}}, "'lineOrder' can't be chosen"),
        ({"attributes": {"chunkCount": 1}}, "'chunkCount' can't be chosen"),
        ({"attributes": {"pixelAspectRatio": 1}}, "'pixelAspectRatio' must be float, not int"),
        ({"attributes": {"screenWindowCenter": (1, 2)}}, "must be v2f, not v2i"),
        ({"attributes": {"pixelAspectRatio": 0.0}}, "pixel aspect of 0.0"),
        ({"attributes": {"pixelAspectRatio": float("nan")}}, "pixel aspect of nan"),
        ({"attributes": {"screenWindowWidth": -1.0}}, "screen window -1.0 wide"),
        ({"data_window": (2**30, 0, 2**30 + 1, 1)}, "data window"),
        ({"data_window": (0, 0, 2, 1)}, "2 x 2 pixels can't fill the data window"),
        ({"display_window": (0, 0, -1, 4)}, "display window"),
        ({"display_window": (0, 0, 4, 2**31)}, "display window"),
    ],
)
def test_refuses_what_no_file_can_hold(settings, words):
    with pytest.raises(ValueError, match=words):
        encode({"Y": picture("smooth", 2, 2)}, **settings)


def test_refuses_channel_names_that_no_file_can_hold():
    for name in ("", "x" * 256, "a\0b"):
        with pytest.raises(ValueError, match="1 to 255"):
            encode({name: picture("smooth", 2, 2)})


@pytest.mark.parametrize(("kind", "stored"), [("noise", True), ("constant", False)])
def test_chunks_that_compression_would_enlarge_are_stored(kind, stored):
    plane = picture(kind, 40, 33)
    body = encode({"Y": plane})
    table = exr.read_header(body).parts[0].chunks.table(memoryview(body)).tolist()
    for number, (offset, lines) in enumerate(zip(table, (16, 16, 8), strict=True)):
        top, size = struct.unpack_from("<2i", body, offset)
        assert top == 16 * number
        raw = plane[top : top + lines].tobytes()
        if stored:
            assert body[offset + 8 : offset + 8 + size] == raw
        else:
            assert size < len(raw) / 20


@pytest.mark.parametrize("dtype", [np.uint8, np.bool_, np.int64, np.float64, ">f4", ">f2"])
def test_all_kinds_of_numbers(dtype):
    plane = (np.arange(60).reshape(5, 12) % 2).astype(dtype)
    for view in (plane, plane.T, plane[::-1, ::2]):
        found = by_library(encode({"h": view, "f": view}, half=["h"]))
        np.testing.assert_array_equal(found["h"], view)
        np.testing.assert_array_equal(found["f"], view)


def test_memory_is_the_output_and_some_strips(monkeypatch):
    monkeypatch.setattr(exrencode, "MAX_STRIP", 2**17)
    plane = picture("smooth", 2048, 1024).astype(np.float64)
    tracemalloc.start()
    pieces = exrencode.encode({"Y": plane}, {"Y"}, *[(0, 0, 1023, 2047)] * 2, "zip", {})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1.5 * sum(map(len, pieces)) + thread_count() * 16 * 2**17
