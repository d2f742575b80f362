"""POST /shade: the answer, what it says about itself, and every parameter."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from PIL import Image

from deepshade import exr

EXR = {"Content-Type": "image/x-exr"}


def shade(client, body, query="", effect="ao"):
    return client.post(f"/shade/{effect}{query}", content=body, headers=EXR)


def test_answer_is_an_exr_that_says_how_it_was_made(client, make_exr):
    response = shade(client, make_exr(40, 56, attributes={"deepshade:radius": 2.0}))
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "image/x-exr"
    image = exr.read(response.content)
    assert list(image.pixels) == ["Y"]
    assert image.pixels["Y"].shape == (40, 56)
    assert 0 <= image.pixels["Y"].min() < image.pixels["Y"].max() <= 1
    part = image.header.parts[0]
    assert part.channels == {"Y": "half"}
    assert part.compression == "zip"
    expected = {
        "effect": "ao",
        "bundle": "tiny",
        "engine": "onnxruntime",
        "precision": "fp32",
        "radius": 2.0,
        "radius_source": "header",
        "background_pixels": 0,
        "nonfinite_pixels": 0,
        "derived": "",
    }
    for name, value in expected.items():
        assert part.attributes[f"deepshade:{name}"] == value, name
        header = response.headers["deepshade-" + name.replace("_", "-")]
        assert header == str(value).removesuffix(".0"), name
    assert len(part.attributes["deepshade:bundle_sha256"]) == 64
    stages = re.findall(r"(\w+);dur=([\d.]+)", response.headers["server-timing"])
    assert [name for name, _ in stages] == ["decode", "plan", "infer", "encode"]


def test_radius_from_request_then_header(client, make_exr):
    marked = make_exr(16, 16, attributes={"deepshade:radius": 2.0})
    for query, radius, source in (("", "2", "header"), ("?radius=0.25", "0.25", "request")):
        headers = shade(client, marked, query).headers
        assert (headers["deepshade-radius"], headers["deepshade-radius-source"]) == (radius, source)


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_a_scaled_scene_with_a_scaled_radius_shades_alike(client, make_exr, make_picture, scale):
    channels = make_picture(64, 48)
    scaled = {
        name: plane * np.float32(scale) if name.startswith("position") else plane
        for name, plane in channels.items()
    }
    a = shade(client, make_exr(channels), "?radius=0.5&half=false").content
    b = shade(client, make_exr(scaled), f"?radius={0.5 * scale}&half=false").content
    np.testing.assert_allclose(exr.read(a).pixels["Y"], exr.read(b).pixels["Y"], atol=1e-5)


@pytest.mark.parametrize("compression", sorted(exr.COMPRESSIONS))
def test_compressions(client, make_exr, compression):
    response = shade(client, make_exr(8, 8), f"?compression={compression}")
    assert exr.read_header(response.content).parts[0].compression == compression


def test_float_pixels(client, make_exr):
    response = shade(client, make_exr(8, 8), "?half=false")
    assert exr.read_header(response.content).parts[0].channels == {"Y": "float"}


def test_png_of_occlusion_is_its_plain_value(client, make_exr):
    response = shade(client, make_exr(24, 32), "?format=png")
    assert response.headers["content-type"] == "image/png"
    png = np.asarray(Image.open(io.BytesIO(response.content)))
    assert png.shape == (24, 32)
    assert png.dtype == np.uint8
    linear = exr.read(shade(client, make_exr(24, 32), "?half=false").content).pixels["Y"]
    np.testing.assert_allclose(png / 255, linear, atol=0.51 / 255)


def test_the_answer_has_the_window_of_the_part_that_was_shaded(client, make_exr, make_picture):
    """A beauty pass, cropped to what it shows, comes first: in its own file, and as a part."""
    beauty = {name: np.ones((4, 6), np.float32) for name in "RGBA"}
    other = make_exr(beauty, data_window=(20, 10, 25, 13), display_window=(0, 0, 39, 29))
    body = make_exr(make_picture(16, 24), data_window=(3, 5, 26, 20), display_window=(0, 0, 39, 29))
    files = [("image", ("beauty.exr", other)), ("image", ("data.exr", body))]
    response = client.post("/shade/ao", files=files)
    assert response.status_code == 200, response.text
    part = exr.read_header(response.content).parts[0]
    assert part.data_window == (3, 5, 26, 20)
    assert part.display_window == (0, 0, 39, 29)
    assert response.headers["deepshade-background-pixels"] == "0"
    assert len(response.headers["deepshade-bundle-sha256"]) == 64


def test_one_file_per_attribute(client, make_exr, make_picture):
    channels = make_picture(16, 24)
    whole = shade(client, make_exr(channels), "?half=false").content
    halves = {
        name: make_exr({k[-1]: v for k, v in channels.items() if k.startswith(name)})
        for name in ("normal", "position")
    }
    for files in (
        {name: ("x.exr", body, "image/x-exr") for name, body in halves.items()},
        [("image", (f"{name}.exr", body)) for name, body in halves.items()],
    ):
        response = client.post("/shade/ao?half=false", files=files)
        assert response.status_code == 200, response.text
        np.testing.assert_array_equal(
            exr.read(response.content).pixels["Y"], exr.read(whole).pixels["Y"]
        )


def test_a_form_with_one_file_equals_the_raw_body(client, make_exr):
    body = make_exr(16, 24)
    response = client.post("/shade/ao", files={"image": ("view.exr", body)})
    assert (
        exr.read(response.content).pixels["Y"] == exr.read(shade(client, body).content).pixels["Y"]
    ).all()


def test_map_names_the_channels(client, make_exr, make_picture):
    channels = {
        name.replace("normal", "thing"): plane for name, plane in make_picture(16, 16).items()
    }
    # The name says nothing, so without a mapping the normal has to be derived from the positions.
    response = shade(client, make_exr(channels), "?map=normal=thing")
    assert response.status_code == 200, response.text
    assert "thing.X" in response.headers["deepshade-mapped"]


def test_position_is_derived_from_depth_and_the_field_of_view(client, make_exr, make_picture):
    channels = make_picture(16, 16)
    depth = {"Z": -channels["position.Z"]} | {
        name: plane for name, plane in channels.items() if name.startswith("normal")
    }
    response = shade(client, make_exr(depth))
    assert response.status_code == 422
    assert "fov" in response.text
    response = shade(client, make_exr(depth), "?fov=60")
    assert response.status_code == 200, response.text
    assert "position" in response.headers["deepshade-derived"]


def test_windows_and_camera_are_kept(client, make_exr):
    body = make_exr(
        16,
        24,
        data_window=(30, 20, 53, 35),
        display_window=(0, 0, 99, 79),
        attributes={"deepshade:fov": 40.0},
    )
    part = exr.read_header(shade(client, body).content).parts[0]
    assert part.data_window == (30, 20, 53, 35)
    assert part.display_window == (0, 0, 99, 79)
    assert part.attributes["deepshade:fov"] == 40.0


def test_pixels_that_are_not_finite_are_background_and_do_not_spread(
    client, make_exr, make_picture
):
    channels = make_picture(64, 64)
    hole = np.zeros((64, 64), bool)
    hole[10, 20] = hole[40:44, 50:60] = True
    empty = {name: np.where(hole, 0, plane) for name, plane in channels.items()}
    broken = {name: plane.copy() for name, plane in channels.items()}
    broken["normal.X"][hole] = np.nan
    broken["position.Y"][hole] = np.inf
    expected = shade(client, make_exr(empty), "?half=false")
    response = shade(client, make_exr(broken), "?half=false")
    assert response.headers["deepshade-nonfinite-pixels"] == str(hole.sum())
    assert response.headers["deepshade-background-pixels"] == str(hole.sum())
    found = exr.read(response.content).pixels["Y"]
    assert (found[hole] == 1).all()
    np.testing.assert_array_equal(found, exr.read(expected.content).pixels["Y"])


def test_nothing_but_background_is_white(client, make_exr, make_picture):
    channels = {name: np.full_like(p, np.nan) for name, p in make_picture(9, 9).items()}
    response = shade(client, make_exr(channels))
    assert (exr.read(response.content).pixels["Y"] == 1).all()
    assert response.headers["deepshade-nonfinite-pixels"] == "81"


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (63, 65), (129, 257)])
def test_any_size(client, make_exr, size):
    response = shade(client, make_exr(*size))
    assert exr.read(response.content).pixels["Y"].shape == size


def test_extreme_radii_stay_finite(client, make_exr):
    for radius in ("1e-30", "1e30"):
        response = shade(client, make_exr(16, 16), f"?radius={radius}&half=false")
        assert response.status_code == 200
        assert np.isfinite(exr.read(response.content).pixels["Y"]).all()
