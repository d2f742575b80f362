"""Live frames: every bit comes back, and no message from a stranger does more than raise."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from isal import isal_zlib

from deepshade import exr, live
from deepshade.errors import DamagedImageError, LimitError
from deepshade.gbuffer import load_gbuffer
from deepshade.live import codecs

LIMITS = exr.Limits(pixels=10_000, channels=8)


def packed(given: dict[str, np.ndarray], codec: str = "raw", **about: object) -> bytes:
    return live.pack(live.GBUFFER, 7, given, about, codec=codec, time=1.5, sent=2.5, flags=live.CUT)


def noise(shape: tuple[int, int], kind: str) -> np.ndarray:
    """All bit patterns: NaN, infinities, zeros of both signs, subnormals."""
    bits = np.random.default_rng(3).integers(0, 256, (*shape, np.dtype(kind).itemsize), np.uint8)
    return bits.view(kind)[..., 0]


@pytest.mark.parametrize("codec", live.available())
@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (64, 80)])
def test_every_bit_comes_back(codec, shape):
    planes = {
        "Z": noise(shape, "<f4"),
        "normal.X": noise(shape, "<f2"),
        "zero": np.zeros(shape, "f2"),
    }
    frame = live.parse(packed(planes, codec, header={"deepshade:fov": 50.0}), LIMITS)
    assert (frame.id, frame.time, frame.sent, frame.flags) == (7, 1.5, 2.5, live.CUT)
    found = frame.planes()
    assert list(found) == list(planes)
    for name, plane in planes.items():
        assert found[name].dtype == plane.dtype
        assert found[name].tobytes() == plane.tobytes()


def test_without_the_extra_there_are_codecs_that_everybody_has(monkeypatch):
    monkeypatch.setattr(codecs, "installed", lambda name: False)
    codecs.available.cache_clear()
    try:
        assert codecs.available() == ("raw", "deflate")
    finally:
        codecs.available.cache_clear()


def test_deflate_is_what_browsers_inflate():
    """zlib of split bytes, read here by Python's own zlib."""
    import zlib

    plane = np.arange(12, dtype="<f4").reshape(3, 4)
    split = zlib.decompress(codecs.encode(plane, "deflate"))
    assert split == bytes(plane.tobytes()[k + 4 * i] for k in range(4) for i in range(12))


@pytest.mark.parametrize("codec", live.available())
def test_a_plane_that_says_another_size_is_refused(codec):
    small, large = np.zeros((4, 4), "<f4"), np.zeros((400, 400), "<f4")
    for stored, said in ((large, small), (small, large)):
        with pytest.raises(DamagedImageError):
            codecs.decode(codecs.encode(stored, codec), codec, said.dtype, said.shape)


def test_a_bomb_is_not_inflated():
    bomb = isal_zlib.compress(bytes(50_000_000), 1)
    with pytest.raises(DamagedImageError, match="not 64 bytes"):
        codecs.decode(bomb, "deflate", np.dtype("<f4"), (4, 4))


def with_head(**changed: int) -> bytes:
    message = bytearray(packed({"Z": np.zeros((4, 4), "<f4")}))
    for at, value in changed.items():
        struct.pack_into("<I", message, int(at[1:]), value)
    return bytes(message)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (b"", "begins with 40 bytes"),
        (b"GIF89a" + bytes(60), "begins with"),
        (with_head(_4=2), "version 2"),
        (with_head(_4=0x00FF0101), "codec 255"),
        (with_head(_12=0), "0 x 4 pixels"),
        (with_head(_20=2**31), "JSON of 2147483648 bytes"),
        (with_head(_20=3), "can't be read"),
        (packed({"Z": np.zeros((4, 4), "<f4")})[:-1], "ends beyond"),
        (packed({"Z": np.zeros((4, 4), "<f4")}) + b"\1", "within a plane's size"),
        (packed({"Z": np.zeros((4, 4), "<f4")}) + bytes(4), "1 planes are listed, 2"),
        (packed({"Z": np.zeros((4, 4), "<f4")}, planes=[["Z", "half"]]), "64 bytes, it must be 32"),
        (packed({"Z": np.zeros((4, 4), "<f4")}, planes=[["Z", "int"]]), '"half" or "float"'),
        (packed({"Z": np.zeros((4, 4), "<f4")}, planes=[]), "must be a list"),
        (packed({"Z": np.zeros((4, 4), "<f4")}, header=[]), "must be an object"),
    ],
)
def test_what_is_no_frame_says_so(message, said):
    with pytest.raises(live.FrameError, match=said):
        live.parse(message, LIMITS)


def test_limits_hold_before_anything_is_allocated():
    with pytest.raises(LimitError, match="pixels"):
        live.parse(with_head(_12=2**31, _16=2**31), LIMITS)
    many = {f"p{index}": np.zeros((1, 1), "<f4") for index in range(9)}
    with pytest.raises(LimitError, match="channels"):
        live.parse(packed(many), LIMITS)


# imagecodecs tells of damage inside a block of htj2k on standard error alone, and goes on
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@settings(max_examples=150, deadline=None)
@given(st.data())
def test_changed_bytes_raise_nothing_else(data):
    codec = data.draw(st.sampled_from(live.available()))
    plane = np.linspace(0, 1, 48, dtype="<f4").reshape(6, 8)
    message = bytearray(packed({"Z": plane, "Y": plane.astype("<f2")}, codec))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = live.parse(bytes(message), LIMITS)
        if frame.kind == live.GBUFFER:
            frame.picture()
    except (DamagedImageError, LimitError):
        pass


@pytest.mark.parametrize("value", [None, True, [1, 2, 3, 4], ["a", "b"], "x" * 1001, {"a": 1}])
def test_headers_hold_numbers_texts_vectors_and_matrices(value):
    frame = live.parse(packed({"Z": np.zeros((2, 2), "<f4")}, header={"odd": value}), LIMITS)
    with pytest.raises(live.FrameError, match="'odd'"):
        frame.picture()


def test_planes_are_read_as_an_exr_of_them_would_be():
    """The same G-buffer, whether its bytes were a file or never one."""
    rng = np.random.default_rng(0)
    pixels = {f"normal.{axis}": rng.normal(0, 0.02, (24, 32)).astype("<f2") for axis in "XYZ"}
    pixels["normal.Z"] += np.float16(1)
    pixels["Z"] = np.full((24, 32), 3, "<f4")
    pixels["Z"][:4] = np.inf
    pixels["Z"][9, 9] = np.nan
    matrix = np.eye(4, dtype=np.float32)
    header = {"deepshade:fov": 50.0, "worldToCamera": matrix}
    file = io.BytesIO()
    half = [name for name in pixels if name != "Z"]
    exr.write(file, pixels, attributes=header, half=half)
    about = {"deepshade:fov": 50.0, "worldToCamera": matrix.ravel().tolist()}
    frame = live.parse(packed(pixels, "deflate", header=about), LIMITS)
    needs = ["normal", "position"]
    ours = load_gbuffer([("", frame.picture())], needs)
    theirs = load_gbuffer(file.getvalue(), needs)
    assert ours.nonfinite == theirs.nonfinite == 1
    np.testing.assert_array_equal(ours.background, theirs.background)
    for name in needs:
        np.testing.assert_array_equal(ours.attributes[name], theirs.attributes[name])
    assert ours.derived == theirs.derived
