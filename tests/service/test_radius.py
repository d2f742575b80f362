"""Which radius a picture is shaded at: the one named, else a share of its median depth."""

import io
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.bundles import Bundle
from deepshade.gbuffer import load_gbuffer
from deepshade_service.parameters import ShadeParameters
from deepshade_service.radius import radius_of

EXR = {"Content-Type": "image/x-exr"}


def shade(client, body, query=""):
    response = client.post(f"/shade/ao?half=false{query}", content=body, headers=EXR)
    assert response.status_code == 200, response.text
    return response


def pixels(response):
    return exr.read(response.content).pixels["Y"]


@pytest.mark.parametrize("unit", [1.0, 100.0, 1e-3])
def test_a_scene_in_any_unit_shades_alike_when_nobody_names_a_radius(
    client, make_exr, make_picture, unit
):
    metres = make_picture(64, 96)
    scaled = {n: p * np.float32(unit if n[0] == "p" else 1) for n, p in metres.items()}
    response = shade(client, make_exr(scaled))
    np.testing.assert_allclose(pixels(response), pixels(shade(client, make_exr(metres))), atol=1e-4)
    depth = np.median(-scaled["position.Z"])
    said = response.headers
    radius = float(said["deepshade-radius"])
    assert radius == pytest.approx(0.15 * depth, rel=0.02)  # of every eighth pixel, here of all
    assert said["deepshade-radius-source"] == "depth"
    assert f"radius: {radius:g}, 15% of the median depth" in said["deepshade-derived"]
    assert "deepshade-warnings" not in said
    # naming it gives the same picture
    np.testing.assert_array_equal(
        pixels(response), pixels(shade(client, make_exr(scaled), f"&radius={radius:.9g}"))
    )


@pytest.mark.parametrize("asked", ["10%", "10%25", "10.0%25"])
def test_a_percentage_is_of_the_median_depth(client, make_exr, asked):
    body = make_exr(64, 64, attributes={"deepshade:radius": 3.0})
    plan = shade(client, body, f"&explain=1&radius={asked}").json()
    whole = shade(client, body, "&explain=1&radius=100%25").json()
    assert plan["radius"] == pytest.approx(whole["radius"] / 10, rel=1e-3)
    assert plan["radius_source"] == "request"
    assert "10% of the median depth" in plan["derived"]["radius"]
    assert whole["warnings"]


@pytest.mark.parametrize("asked", ["x%25", "%25", "-1%25", "nan%25", "1%25%25", "0%25"])
def test_no_percentage(client, make_exr, asked):
    response = client.post(f"/shade/ao?radius={asked}", content=make_exr(4, 4), headers=EXR)
    assert response.status_code == 422
    assert "radius" in response.json()["detail"]


@pytest.mark.parametrize(("share", "warned"), [(0.01, True), (0.1, False), (2, True)])
@pytest.mark.parametrize("where", ["request", "header"])
def test_a_radius_beyond_what_was_learnt_is_warned_of(client, make_exr, share, warned, where):
    depth = shade(client, make_exr(64, 64), "&explain=1&radius=100%25").json()["radius"]
    named = {"deepshade:radius": share * depth} if where == "header" else {}
    query = f"&radius={share * depth}" if where == "request" else ""
    response = shade(client, make_exr(64, 64, attributes=named), query)
    said = response.headers.get("deepshade-warnings", "")
    assert bool(said) == warned
    attributes = exr.read_header(response.content).parts[0].attributes
    assert attributes.get("deepshade:warnings", "") == said
    if warned:
        assert f"{100 * share:g}% of the median depth" in said
        advised = float(said.rpartition(" is ")[2])
        fine = shade(client, make_exr(64, 64), f"&radius={advised}")
        assert "deepshade-warnings" not in fine.headers


def test_tiles_have_the_radius_of_the_whole_picture(start, client, make_exr):
    body = make_exr(512, 512)
    tiled = shade(start(memory=30 * 2**20).client, body, "&explain=1").json()
    whole = shade(client, body, "&explain=1").json()
    assert tiled["pixels"]["tiles"] > whole["pixels"]["tiles"] == 1
    assert tiled["radius"] == whole["radius"]


def test_a_picture_of_nearly_or_only_background(client, make_exr, make_picture):
    """One surface between those that are looked at, and none at all."""
    for count in (1, 0):
        view = {name: np.zeros_like(plane) for name, plane in make_picture(32, 32).items()}
        view["normal.Z"][3, 3 : 3 + count] = 1
        view["position.Z"][3, 3 : 3 + count] = -200
        plan = shade(client, make_exr(view), "&explain=1").json()
        expected = (30.0, "depth") if count else (0.5, "bundle")
        assert (plan["radius"], plan["radius_source"]) == expected


@pytest.mark.parametrize(("asked", "warned"), [(None, False), (0.3, False), (2.0, True)])
def test_a_bundle_that_sees_no_lengths_keeps_its_radius_and_says_so(asked, warned):
    inputs = ("normal_object",)
    bundle = Bundle(Path(), "ao", "cat", inputs, ("Y",), 0.3, 50.0, 1, 10, 400)
    body = io.BytesIO()
    exr.write(body, {f"normal_object.{axis}": np.ones((8, 8), np.float32) for axis in "XYZ"})
    gbuffer = load_gbuffer(body.getvalue(), inputs)
    found = radius_of(gbuffer, bundle, ShadeParameters(radius=asked))
    assert (found.value, found.source) == (0.3, "bundle")
    assert bool(found.warning) == warned
