"""What a request says of the stored values, and what it is told of them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr

CASES = Path(__file__).parents[1] / "cases"
EXR = {"Content-Type": "image/x-exr"}
FOV = {"deepshade:fov": float(np.degrees(2 * np.arctan(0.5)))}  # that of the pictures


def answer(client, body, query=""):
    return client.post(f"/shade/ao?radius=0.5&{query}", content=body, headers=EXR)


def pixels(response):
    assert response.status_code == 200, response.text
    return exr.read(response.content).pixels["Y"]


def test_a_body_may_be_named_as_a_file_is(client):
    content = (CASES / "shot_depth_Y.exr").read_bytes()
    for name, status in (("shot_depth_Y.exr", 200), ("shot.exr", 422)):
        headers = EXR | {"Content-Disposition": f'attachment; filename="{name}"'}
        found = client.post("/shade/ao?radius=0.5", content=content, headers=headers)
        assert found.status_code == status


def scaled(picture, name, factors):
    turned = {f"{name}.{c}": f for c, f in zip("XYZ", factors, strict=True)}
    return picture | {channel: f * picture[channel] for channel, f in turned.items()}


@pytest.fixture(scope="module")
def right(client, make_exr, make_picture):
    return pixels(answer(client, make_exr(make_picture(48, 48), attributes=FOV)))


def test_other_axes_are_found_out_or_said(client, make_exr, make_picture, right):
    picture = scaled(make_picture(48, 48), "position", (1, -1, -1))
    body = make_exr(scaled(picture, "normal", (1, -1, -1)), attributes=FOV)
    found = answer(client, body)
    np.testing.assert_array_equal(pixels(found), right)
    assert "x,-y,-z (opencv)" in found.headers["Deepshade-Derived"]
    said = answer(client, body, "axes=opencv&strict=1")
    np.testing.assert_array_equal(pixels(said), right)
    assert said.headers["Deepshade-Derived"] == ""
    plan = answer(client, body, "explain=1").json()
    assert "opencv" in plan["derived"]["normal"]


def test_depth_and_normals_as_they_are_said_to_be(client, make_exr, make_picture, right):
    picture = make_picture(48, 48)
    channels = {name: plane / 2 + 0.5 for name, plane in picture.items() if "normal" in name}
    channels["Z"] = (-picture["position.Z"] - 1) / 9
    query = "normals=encoded&depth=normalised&near=1&far=10"
    shade = pixels(answer(client, make_exr(channels, attributes=FOV), query))
    np.testing.assert_allclose(shade, right, atol=5e-3)


def test_warnings_are_said_and_strict_makes_them_errors(client, make_exr, make_picture):
    body = make_exr(make_picture(48, 48), attributes={"deepshade:fov": 100.0})
    warned = answer(client, body)
    assert "53.1°".encode("ascii", "replace").decode() in warned.headers["Deepshade-Warnings"]
    header = exr.read_header(warned.content).parts[0].attributes
    assert "field of view" in header["deepshade:warnings"]
    assert answer(client, body, "explain=1").json()["warnings"]
    refused = answer(client, body, "strict=1")
    assert refused.status_code == 422
    assert refused.json()["type"].endswith("contradiction")
    assert answer(client, body, "trust=1").headers.get("Deepshade-Warnings") is None


def contradicting(picture, kind):
    noise = np.random.default_rng(0).normal(size=(3, 48, 48)).astype(np.float32)
    if kind == "noise":
        for letter, plane in zip("XYZ", noise / np.linalg.norm(noise, axis=0), strict=True):
            picture[f"normal.{letter}"] = plane
    elif kind == "world":
        picture["position.X"] = picture["position.X"] + np.float32(20)
    else:
        for letter in "XYZ":
            picture[f"position.{letter}"] *= 0
    return picture


@pytest.mark.parametrize("kind", ["noise", "world", "empty"])
def test_advice_names_parameters_and_following_it_works(client, make_exr, make_picture, kind):
    matrix = np.eye(4, dtype=np.float32)
    matrix[3, 0] = -20  # for row vectors, as OpenEXR has it
    header = FOV | ({"worldToCamera": matrix} if kind == "world" else {})
    body = make_exr(contradicting(make_picture(48, 48), kind), attributes=header)
    problem = answer(client, body)
    assert problem.status_code == 422
    fix = problem.json()["fix"]
    assert "--" not in fix
    advice = [a for a in re.findall(r"\?([a-z_]+=[^\s;,]+)", fix) if "<" not in a]
    assert advice[-1] == "trust=1"
    for each in advice:
        assert answer(client, body, each).status_code == 200, each


@pytest.mark.parametrize(
    "query",
    [
        "axes=opencl",
        "axes=depth:x,y,z",
        "depth=zbuffer",
        "depth=normalised&near=2&far=1",
        "strict=1&trust=1",
        "normals=odd",
        "derive=nothing",
    ],
)
def test_what_can_not_be_meant(client, make_exr, query):
    problem = answer(client, make_exr(8, 8), query)
    assert problem.status_code == 422
    assert problem.json()["type"].endswith("bad-parameter")
