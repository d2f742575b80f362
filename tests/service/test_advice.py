"""Every fix that an answer offers is followed: it leads to the right picture, or on to less."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.camera import Camera

CASES = Path(__file__).parents[1] / "cases"
EXR = {"Content-Type": "image/x-exr"}
SIZE = 64
FOV = float(np.degrees(2 * np.arctan(0.5)))  # that of the pictures
HEADER = {"deepshade:fov": FOV}
MATRIX = Camera.look_at((3, 2, 5), (0.2, 0.1, 0), (0, 1, 0), FOV, SIZE, SIZE).matrix


def ask(client, body, query):
    return client.post(f"/shade/ao?radius=0.5&{query}", content=body, headers=EXR)


def followed(fix, query):
    """The queries that a fix asks for instead of `query`; what has to be filled in isn't any."""
    given = dict(pair.split("=", 1) for pair in query.split("&") if pair)
    found = []
    for without in re.findall(r"leave out \?([a-z_]+)=", fix):
        found.append("&".join(f"{k}={v}" for k, v in given.items() if k != without))
    fix = re.sub(r"leave out \?([a-z_]+)=\d?", "", fix)
    for advice in re.findall(r"\?([a-z_]+=[^\s;?]*[^\s;,.?)])", fix):
        if "<" not in advice:
            told = {pair.split("=", 1)[0] for pair in advice.split("&")}
            kept = [f"{k}={v}" for k, v in given.items() if k not in told]
            found.append("&".join([*kept, advice]))
    return found


def vectors(name, planes, letters="XYZ"):
    return {f"{name}.{c}": plane for c, plane in zip(letters, planes, strict=True)}


def stack(picture, name):
    return np.stack([picture[f"{name}.{c}"] for c in "XYZ"])


def with_depth(picture):
    return vectors("normal", stack(picture, "normal")) | {"Z": -picture["position.Z"]}


def placed(picture):
    """World-space positions and normals."""
    inverse = np.linalg.inv(MATRIX)
    points = np.tensordot(inverse[:3, :3], stack(picture, "position"), 1)
    points += inverse[:3, 3, None, None]
    return points, np.tensordot(inverse[:3, :3], stack(picture, "normal"), 1)


def noise(picture):
    found = np.random.default_rng(0).normal(size=(3, SIZE, SIZE))
    return found / np.linalg.norm(found, axis=0)


SEEN = HEADER | {"worldToCamera": MATRIX.T.astype(np.float32)}
# what a picture is made into: its channels, its header, and what is asked of it
HARD = {
    "no field of view": (with_depth, {}, ""),
    "another field of view": (with_depth, {}, "fov=25&strict=1"),
    "a planes' depth": (with_depth, HEADER, "depth=zbuffer"),
    "noise for normals": (
        lambda p: vectors("normal", noise(p)) | vectors("position", stack(p, "position")),
        HEADER,
        "",
    ),
    "world for camera": (
        lambda p: vectors("normal", stack(p, "normal")) | vectors("position", placed(p)[0]),
        SEEN,
        "",
    ),
    "letters twice": (
        lambda p: p | vectors("normal", stack(p, "normal"), "RGB"),
        HEADER,
        "",
    ),
    "any renderer's": (
        lambda p: vectors("NORMAL", stack(p, "normal")) | vectors("position", stack(p, "position")),
        HEADER,
        "",
    ),
    "a slip": (
        lambda p: vectors("nornal", stack(p, "normal")) | vectors("position", stack(p, "position")),
        HEADER,
        "",
    ),
    "a suffix": (
        lambda p: (
            vectors("normal_main", stack(p, "normal"))
            | vectors("position_main", stack(p, "position"))
        ),
        HEADER,
        "",
    ),
    "LuxCore's": (
        lambda p: vectors("POSITION", placed(p)[0]) | vectors("SHADING_NORMAL", placed(p)[1]),
        SEEN,
        "",
    ),
    "a view that isn't there": (lambda p: p, HEADER, "view=left"),
    "two views": (
        lambda p: {
            f"{eye}.{name}": plane for eye in ("left", "right") for name, plane in p.items()
        },
        HEADER,
        "",
    ),
    "a lens of both kinds": (with_depth, HEADER, "fov=50&ortho_width=3"),
    "mirrored depth": (lambda p: with_depth(p) | {"Z": p["position.Z"]}, HEADER, "strict=1"),
}


@pytest.mark.parametrize("name", HARD)
def test_advice_is_followed(client, make_exr, make_picture, name):
    picture = make_picture(SIZE, SIZE)
    wanted = exr.read(ask(client, make_exr(picture, attributes=HEADER), "").content).pixels["Y"]
    change, header, query = HARD[name]
    channels = {key: plane.astype(np.float32) for key, plane in change(picture).items()}
    body = make_exr(channels, attributes=header)
    seen = {(query, "")}
    todo, right = [query], 0
    while todo:
        query = todo.pop()
        answer = ask(client, body, query)
        if answer.status_code == 200:
            if "trust=1" in query:
                continue  # on their own word
            off = np.abs(exr.read(answer.content).pixels["Y"] - wanted).mean()
            assert off < 0.02 or answer.headers.get("Deepshade-Warnings"), query
            right += off < 0.02
            continue
        assert answer.status_code == 422, answer.text
        problem = answer.json()
        assert "--" not in problem["fix"]
        assert "--" not in problem["detail"]
        if "trust=1" in query:
            continue
        for further in followed(problem["fix"], query):
            assert further != query
            # the same error once more is no help
            if (further, problem["detail"]) not in seen:
                seen.add((further, problem["detail"]))
                again = ask(client, body, further)
                same = again.status_code != 200 and again.json()["detail"] == problem["detail"]
                assert not same, f"{further}: {problem['detail']}"
                todo.append(further)
        assert len(seen) < 40, "advice goes round in circles"
    if name != "a planes' depth":  # which only who wrote them knows
        assert right, "no advice led to the picture"


@pytest.mark.parametrize("name", ["ortho_depth_normal", "parts_fov"])
def test_advice_on_files(client, name):
    body = (CASES / f"{name}.exr").read_bytes()
    problem = ask(client, body, "").json()
    advice = followed(problem["fix"], "")
    assert advice
    for query in advice:
        answer = ask(client, body, query)
        assert answer.status_code == 200, answer.text
        warned = answer.headers.get("Deepshade-Warnings", "")
        assert ("orthographic" in warned) == (name == "ortho_depth_normal")
