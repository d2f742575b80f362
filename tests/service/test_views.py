"""Stereo files and files of parts: each view with its own camera, one or several at a time."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from deepshade import exr
from deepshade.exr.entries import Entry

CASES = Path(__file__).parents[1] / "cases"
EXR = {"Content-Type": "image/x-exr"}


def ask(client, body, query=""):
    return client.post(f"/shade/ao?radius=0.5&{query}", content=body, headers=EXR)


def plane(response, name="Y"):
    assert response.status_code == 200, response.text
    return exr.read(response.content).pixels[name]


def entry(response, name):
    return exr.read_header(response.content).parts[0].attributes.get(name)


@pytest.fixture(scope="module")
def eyes(make_picture):
    """Two different views by name."""
    return {"left": make_picture(32, 40), "right": make_picture(32, 40, 1)}


@pytest.fixture(scope="module")
def single(client, make_exr, eyes):
    """What each gives alone."""
    return {name: plane(ask(client, make_exr(picture))) for name, picture in eyes.items()}


def hero(eyes, order):
    """A single-part file whose second view is named, as `order` puts it."""
    channels = dict(eyes["left"])
    for name, values in eyes["right"].items():
        layer, _, last = name.rpartition(".")
        channels[order.format(layer=layer, last=last)] = values
    packed = b"".join(len(name).to_bytes(4, "little") + name for name in (b"left", b"right"))
    body = io.BytesIO()
    exr.write(body, channels, attributes={"multiView": Entry("stringvector", packed)})
    return body.getvalue()


@pytest.mark.parametrize("order", ["right.{layer}.{last}", "{layer}.right.{last}"])
def test_a_view_is_read_by_name(client, eyes, single, order):
    body = hero(eyes, order)
    for query, name in (("", "left"), ("view=right", "right"), ("view=left", "left")):
        answer = ask(client, body, query)
        np.testing.assert_array_equal(plane(answer), single[name])
        assert entry(answer, "view") == name
        assert f"view: '{name}'" in answer.headers["Deepshade-Derived"]
    problem = ask(client, body, "view=rihgt").json()
    assert problem["fix"].endswith("?view=right")


def test_several_views_in_one_answer(client, eyes, single):
    answer = ask(client, hero(eyes, "right.{layer}.{last}"), "view=right,left")
    np.testing.assert_array_equal(plane(answer), single["right"])
    np.testing.assert_array_equal(plane(answer, "left.Y"), single["left"])
    assert entry(answer, "multiView") == ["right", "left"]
    assert answer.headers["Deepshade-Views"] == "right,left"
    plans = ask(client, hero(eyes, "right.{layer}.{last}"), "view=right,left&explain=1").json()
    assert list(plans) == ["right", "left"]
    # which may be read as it was written
    again = exr.read_header(answer.content)
    assert set(again.parts[0].channels) == {"Y", "left.Y"}


def test_the_part_that_is_asked_for_has_its_own_camera(client, make_exr):
    body = (CASES / "parts_fov.exr").read_bytes()
    problem = ask(client, body).json()
    assert problem["fix"] == "read one view: ?view=wide or ?view=main"
    found = {}
    for name, fov in (("wide", 90), ("main", 45)):
        answer = ask(client, body, f"view={name}")
        assert entry(answer, "deepshade:fov") == fov
        alone = exr.read(body)
        channels = {
            key.split(":")[1]: values for key, values in alone.pixels.items() if key[:4] == name
        }
        found[name] = make_exr(channels, attributes={"deepshade:fov": float(fov)})
        np.testing.assert_array_equal(plane(answer), plane(ask(client, found[name])))


def parts(**planes):
    """A multi-part file: name -> (channels, attributes)."""
    made = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage, **header}, dict(channels), name)
        for name, (channels, header) in planes.items()
    ]
    body = io.BytesIO()
    with OpenEXR.File(made) as file:
        file.write(body)
    return body.getvalue()


def test_nothing_of_another_part_is_used(client, eyes, make_exr):
    picture = {k: v for k, v in eyes["left"].items() if k.startswith("normal")}
    picture["Z"] = -eyes["left"]["position.Z"]
    gone = {name: np.zeros((32, 40), np.float32) for name in "RGBA"}
    other = {"deepshade:fov": 120.0, "worldToCamera": np.eye(4, dtype=np.float32)}
    fov = {"deepshade:fov": float(np.degrees(2 * np.arctan(0.5)))}
    body = parts(beauty=(gone, other), data=(picture, fov))
    alone = ask(client, make_exr(picture, attributes=fov))
    np.testing.assert_array_equal(plane(ask(client, body)), plane(alone))
    unknown = ask(client, parts(beauty=(gone, other), data=(picture, {})))
    assert unknown.status_code == 422
    assert "?fov=" in unknown.json()["fix"]


@pytest.mark.parametrize("query", ["append=1", "format=png", "view=a,b,c,d,e,f,g,h,i"])
def test_what_several_views_can_not_be(client, eyes, query):
    views = "" if "view" in query else "view=left,right&"
    problem = ask(client, hero(eyes, "right.{layer}.{last}"), views + query)
    assert problem.status_code == 422
    assert problem.json()["type"].endswith("bad-parameter")
