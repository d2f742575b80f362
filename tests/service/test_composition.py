"""?append=, ?layer=, ?multiply=: what of the picture itself an answer holds, bit for bit."""

from __future__ import annotations

import io

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from deepshade import exr

EXR = {"Content-Type": "image/x-exr"}


def shade(client, body, query, effect="ao"):
    return client.post(f"/shade/{effect}?{query}", content=body, headers=EXR)


def pixels(response):
    assert response.status_code == 200, response.text
    return exr.read(response.content).pixels


def problem(response):
    assert response.status_code == 422, response.text
    return response.json()["detail"], response.json()["fix"]


@pytest.fixture
def shot(make_picture):
    """A G-buffer with a beauty of radiance up to 4, an alpha, and ids as Cryptomatte has them."""
    rng = np.random.default_rng(5)
    height, width = 12, 16
    beauty = {c: rng.random((height, width), np.float32) * 4 for c in "RGB"}
    # any 32 bits but those of NaN, infinities and denormals
    ids = rng.integers(1 << 23, 0x7F7FFFFF, (height, width), np.uint32).view(np.float32)
    others = {"A": np.ones((height, width), np.float32), "crypto00.R": ids}
    return make_picture(height, width) | beauty | others


def encode(channels, **settings):
    stream = io.BytesIO()
    exr.write(stream, channels, **settings)
    return stream.getvalue()


def test_appended_channels_are_those_of_the_picture(client, shot):
    facts = {"cryptomatte/1/name": "crypto", "owner": "me", "deepshade:radius": 0.5}
    body = encode(shot, half={"R", "G", "B"}, attributes=facts)
    response = shade(client, body, "append=1&layer=AO")
    alone, both = pixels(shade(client, body, "")), pixels(response)
    stored = exr.read(body)
    assert both.keys() == shot.keys() | {"AO.Y"}
    for name, plane in stored.pixels.items():
        assert both[name].tobytes() == plane.tobytes(), name
    np.testing.assert_array_equal(both["AO.Y"], alone["Y"])
    part = exr.read_header(response.content).parts[0]
    assert part.channels == stored.header.parts[0].channels | {"AO.Y": "half"}
    assert part.attributes["cryptomatte/1/name"] == "crypto"
    assert part.attributes["owner"] == "me"
    assert response.headers["deepshade-layer"] == "AO"
    assert response.headers["deepshade-appended"] == str(len(shot))


def test_the_layer_is_the_effect_s_unless_named(client, shot):
    assert "ao.Y" in pixels(shade(client, encode(shot), "append=1"))
    assert list(pixels(shade(client, encode(shot), "layer=AO"))) == ["AO.Y"]
    detail, fix = problem(shade(client, encode(shot | {"ao.V": shot["A"]}), "append=1"))
    assert "has a layer 'ao' already" in detail
    assert "ao.Y" not in shot
    query = fix.rpartition("?")[2]
    assert "ao2.Y" in pixels(shade(client, encode(shot | {"ao.V": shot["A"]}), f"append=1&{query}"))


def test_the_beauty_is_multiplied(client, shot):
    body = encode(shot)
    factor = pixels(shade(client, body, "half=0"))["Y"]
    response = shade(client, body, "multiply=1")
    product = pixels(response)
    assert product.keys() == set("RGBA")
    for band in "RGB":
        np.testing.assert_allclose(product[band], shot[band] * factor, rtol=1e-6)
    np.testing.assert_array_equal(product["A"], shot["A"])
    assert response.headers["deepshade-multiplied"] == "R, G, B"
    both = pixels(shade(client, body, "multiply=1&append=1"))
    assert both.keys() == shot.keys() | {"ao.Y"}
    np.testing.assert_array_equal(both["R"], product["R"])
    np.testing.assert_array_equal(both["normal.X"], shot["normal.X"])


def test_a_png_of_the_multiplied_beauty_is_srgb(client, shot):
    flat = {c: np.full_like(shot["R"], 0.5) for c in "RGB"}
    nothing = {k: 0 * v for k, v in shot.items() if k[:-2] in ("normal", "position")}  # ao is 1
    response = shade(client, encode(shot | flat | nothing), "multiply=1&format=png")
    picture = np.asarray(Image.open(io.BytesIO(response.content)))
    assert np.unique(picture).tolist() == [188]  # 0.5 in sRGB


@pytest.mark.parametrize(
    ("layer", "query"),
    [
        ("ViewLayer.Combined", ""),
        ("rgba", ""),
        ("mine", "&map=beauty=mine"),
    ],
)
def test_where_the_beauty_is(client, shot, make_picture, layer, query):
    channels = make_picture(12, 16) | {f"{layer}.{c}": shot[c] for c in "RGB"}
    response = shade(client, encode(channels), f"multiply=1{query}")
    assert pixels(response).keys() == set("RGB")
    assert response.headers["deepshade-multiplied"] == f"{layer}.R, {layer}.G, {layer}.B"


def test_without_a_beauty_the_fix_names_the_parameter(client, make_exr, shot):
    detail, fix = problem(shade(client, make_exr(12, 16), "multiply=1"))
    assert "missing 'beauty'" in detail
    assert "beauty=" in fix
    two = shot | {"rgb.R": shot["R"], "rgb.G": shot["G"], "rgb.B": shot["B"]}
    response = shade(client, encode(two), "multiply=1")
    assert response.headers["deepshade-multiplied"] == "rgb.R, rgb.G, rgb.B"  # it has the name


def test_a_file_an_attribute(client, shot):
    files = {
        "shot_normal.0001.exr": {c: shot[f"normal.{c}"] for c in "XYZ"},
        "shot_position.0001.exr": {c: shot[f"position.{c}"] for c in "XYZ"},
        "shot.0001.exr": {c: shot[c] for c in "RGBA"},
    }
    form = [("image", (name, encode(channels), "image/x-exr")) for name, channels in files.items()]
    both = pixels(client.post("/shade/ao?append=1&multiply=1", files=form))
    names = {f"{layer}.{c}" for layer in ("normal", "position") for c in "XYZ"}
    assert both.keys() == names | set("RGBA") | {"ao.Y"}
    np.testing.assert_array_equal(both["normal.X"], shot["normal.X"])
    whole = pixels(shade(client, encode(shot), "append=1&multiply=1"))
    np.testing.assert_array_equal(both["G"], whole["G"])


def test_parts_and_what_no_answer_can_hold(client, shot):
    """Channels that parts share are told apart; ids as integers and other windows are left out."""

    def part(name, channels):
        planes = {c: OpenEXR.Channel(np.ascontiguousarray(p)) for c, p in channels.items()}
        frame = np.array((0, 0), np.int32), np.array((15, 11), np.int32)
        header = {"type": OpenEXR.scanlineimage, "displayWindow": frame}
        return OpenEXR.Part(header, planes, name)

    surfaces = {k: v for k, v in shot.items() if k.startswith(("normal", "position"))}
    parts = [
        part("rgba", {c: shot[c] for c in "RGB"}),
        part("spare", {c: shot[c] * 2 for c in "RGB"}),
        part("surfaces", surfaces),
        part("ids", {"id": np.arange(192, dtype=np.uint32).reshape(12, 16)}),
        part("small", {"U": np.ones((3, 4), np.float32)}),
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    response = shade(client, stream.getvalue(), "append=1&multiply=1")
    both = pixels(response)
    assert both.keys() == surfaces.keys() | {*"RGB", "spare.R", "spare.G", "spare.B", "ao.Y"}
    np.testing.assert_array_equal(both["spare.R"], shot["R"] * 2)
    assert response.headers["deepshade-left-out"] == "id, U"
    assert response.headers["deepshade-multiplied"] == "rgba:R, rgba:G, rgba:B"


@pytest.mark.parametrize(
    ("effect", "query", "said"),
    [
        ("ao", "append=1&format=png", "a PNG has no layers"),
        ("ao", "layer=a%0Ab", "no layer's name"),
        ("ao", "layer=", "no layer's name"),
    ],
)
def test_refused(client, shot, effect, query, said):
    assert said in shade(client, encode(shot), query, effect).json()["detail"]
