"""G-buffers in others' conventions: read as they are meant, or refused with what helps."""

from __future__ import annotations

import io
import itertools
from pathlib import Path

import numpy as np
import pytest

from deepshade import exr
from deepshade.camera import Camera
from deepshade.errors import ConfigError, ContradictionError
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.axes import EVERY, NAMED, Axes
from deepshade.gbuffer.conventions import Conventions, parse_axes, parse_conventions

CASES = Path(__file__).parents[1] / "cases"
NEEDS = ("normal", "position")
W, H = 96, 64
CAMERA = Camera(50, W, H)


def room() -> tuple[np.ndarray, np.ndarray]:
    """(P, N) of a box that leans, seen from inside: six planes, exact."""
    rays = CAMERA.rays().astype(np.float64)
    lean, _ = np.linalg.qr(np.array([[1, 0.2, 0.3], [-0.1, 1, 0.15], [-0.35, -0.1, 1.0]]))
    best, normals = np.full((H, W), np.inf), np.zeros((3, H, W))
    for axis, side in itertools.product(range(3), (1, -1)):
        n = side * lean[axis] / np.linalg.norm(lean[axis])
        facing = np.tensordot(n, rays, 1)
        hit = np.where(facing < -1e-6, (-1.1 - 0.4 * axis) / np.minimum(facing, -1e-6), np.inf)
        nearer = hit < best
        best[nearer] = hit[nearer]
        normals[:, nearer] = n[:, None]
    return (rays * best).astype(np.float32), normals.astype(np.float32)


P, N = room()
Z = -P[2]
SLANT = np.sqrt((CAMERA.rays() ** 2).sum(0))


def encode(attributes=None, half=(), **planes):
    channels = {}
    for name, array in planes.items():
        letters = "XYZ" if array.ndim == 3 else ("",)
        for letter, plane in zip(letters, array.reshape(-1, H, W), strict=True):
            channels[f"{name}.{letter}".rstrip(".")] = plane.astype(np.float32)
    body = io.BytesIO()
    halves = [name for name in channels if name.split(".")[0] in half]
    header = {"deepshade:fov": 50.0} | (attributes or {})
    exr.write(body, channels, attributes=header, half=halves)
    return body.getvalue()


def check(gbuffer, atol=1e-3):
    assert not gbuffer.background.any()
    np.testing.assert_allclose(gbuffer.attributes["position"], P, atol=atol, rtol=1e-4)
    np.testing.assert_allclose(gbuffer.attributes["normal"], N, atol=2e-3)


@pytest.mark.parametrize("axes", EVERY[::3], ids=str)
def test_axes_of_normals_are_found_out(axes):
    stored = np.empty_like(N)
    for i in range(3):
        stored[axes.order[i]] = N[i] * axes.signs[i]
    gbuffer = load_gbuffer(encode(normal=stored, Z=Z), NEEDS)
    check(gbuffer)
    assert ("normal" in gbuffer.derived) == (axes != Axes())
    if axes != Axes():
        assert str(axes) in gbuffer.derived["normal"]


@pytest.mark.parametrize("name", NAMED)
def test_axes_of_positions_and_normals_are_found_out(name):
    axes = Axes.parse(name)
    turned = [np.empty_like(N), np.empty_like(P)]
    for stored, ours in zip(turned, (N, P), strict=True):
        for i in range(3):
            stored[axes.order[i]] = ours[i] * axes.signs[i]
    body = encode(normal=turned[0], position=turned[1])
    check(load_gbuffer(body, NEEDS))
    # and said, with checks or without
    for checks in ("usual", "strict", "trust"):
        said = Conventions(axes=parse_axes([name]), checks=checks)
        gbuffer = load_gbuffer(body, NEEDS, conventions=said)
        check(gbuffer)
        assert gbuffer.derived == {}


@pytest.mark.parametrize(
    ("stored", "kind"),
    [(Z * SLANT, "distance"), (1 / Z, "inverse"), (-Z, None), (-1 / Z, "inverse")],
    ids=["distance", "inverse", "negative", "negative inverse"],
)
def test_kinds_of_depth_are_found_out(stored, kind):
    gbuffer = load_gbuffer(encode(normal=N, Z=stored), NEEDS)
    check(gbuffer)
    assert "stored" in gbuffer.derived["depth"]
    if kind:
        said = parse_conventions([], None, kind)
        check(load_gbuffer(encode(normal=N, Z=np.abs(stored)), NEEDS, conventions=said))


NEAR, FAR = 0.1, 20.0
BUFFER = (1 / NEAR - 1 / Z) / (1 / NEAR - 1 / FAR)


@pytest.mark.parametrize(
    ("kind", "stored", "far"),
    [
        ("normalised", (Z - NEAR) / (FAR - NEAR), FAR),
        ("zbuffer", BUFFER, FAR),
        ("reversed", 1 - BUFFER, FAR),
        ("reversed", NEAR / Z, None),
    ],
)
def test_depth_between_planes(kind, stored, far):
    body = encode(normal=N, Z=stored)
    said = parse_conventions([], None, kind, NEAR, far)
    check(load_gbuffer(body, NEEDS, conventions=said), atol=5e-3)
    with pytest.raises(ConfigError, match="near"):
        parse_conventions([], None, kind)


@pytest.mark.parametrize(
    ("stored", "word"), [(N / 2 + 0.5, "decoded"), (N * 255, "255"), (N / 2, "0.5")]
)
def test_lengths_of_normals(stored, word):
    gbuffer = load_gbuffer(encode(normal=stored, Z=Z), NEEDS)
    check(gbuffer)
    assert word in gbuffer.derived["normal"]


def test_what_is_right_is_left_alone():
    for planes in ({"Z": Z}, {"position": P}):
        gbuffer = load_gbuffer(encode(normal=N, **planes), NEEDS)
        assert not gbuffer.warnings
        assert set(gbuffer.derived) <= {"position"}
        np.testing.assert_array_equal(gbuffer.attributes["normal"], N)


def test_contradictions_name_what_helps():
    noise = np.random.default_rng(0).normal(size=N.shape)
    noise /= np.linalg.norm(noise, axis=0)
    with pytest.raises(ContradictionError, match="normal") as caught:
        load_gbuffer(encode(normal=noise, Z=Z), NEEDS)
    assert "--derive normal" in caught.value.fix
    gbuffer = load_gbuffer(encode(normal=noise, Z=Z), NEEDS, anew=("normal",))
    assert (np.abs((gbuffer.attributes["normal"] * N).sum(0)) > 0.99).mean() > 0.95
    load_gbuffer(encode(normal=noise, Z=Z), NEEDS, conventions=Conventions(checks="trust"))

    with pytest.raises(ContradictionError, match="everywhere"):
        load_gbuffer(encode(normal=N, position=0 * P), NEEDS)
    with pytest.raises(ContradictionError, match="isn't finite everywhere"):
        load_gbuffer(encode(normal=np.full_like(N, np.nan), position=P), NEEDS)


def test_positions_in_world_space():
    view = Camera.look_at((8, 2, 5), (0, 1, 0), (0, 1, 0), 50, W, H)
    inverse = np.linalg.inv(view.matrix)
    placed = np.tensordot(inverse[:3, :3], P, 1) + inverse[:3, 3, None, None]
    body = encode(normal=N, position=placed)
    with pytest.raises(ContradictionError, match="rays") as caught:
        load_gbuffer(body, NEEDS)
    assert "position_world" in caught.value.fix
    body = encode(view.to_header(), normal=N, position=placed)
    with pytest.raises(ContradictionError, match="in world space they would") as caught:
        load_gbuffer(body, NEEDS)
    assert caught.value.fix.startswith("--map position_world=position")
    check(load_gbuffer(body, NEEDS, mapping={"position_world": "position"}))


def test_warnings_and_strict():
    body = encode(normal=N, position=P, attributes={"deepshade:fov": 90.0})
    (warning,) = load_gbuffer(body, NEEDS).warnings
    assert "50°" in warning
    with pytest.raises(ContradictionError, match="50°"):
        load_gbuffer(body, NEEDS, conventions=Conventions(checks="strict"))
    empty = encode(normal=0 * N, position=0 * P)
    assert "background" in load_gbuffer(empty, NEEDS).warnings[0]


@pytest.mark.parametrize("text", ["", "x,y", "x,x,z", "x,y,w", "opencl", "--x,y,z"])
def test_axes_that_are_none(text):
    with pytest.raises(ConfigError, match="axes"):
        parse_axes([f"position:{text}"])


FOUND = {
    "pbrt_gbuffer_room": "position",
    "unreal_half_room_12000": "position",
    "unreal_half_foliage_3000": "position",
    "normals01_room": "normal",
    "opencv_depth_normal": "normal",
    "opencv_pos_normal": "position",
    "depth_negative_z_room": "depth",
    "depth_nuke_inverse_1_over_z_room": "depth",
    "depth_distance_as_depth_foliage": "depth",
}


@pytest.mark.parametrize("name", FOUND)
def test_cases(name):
    view = "foliage" if "foliage" in name else "room"
    wanted = load_gbuffer(CASES / f"canonical_{view}.exr", NEEDS)
    gbuffer = load_gbuffer(CASES / f"{name}.exr", NEEDS)
    assert FOUND[name] in gbuffer.derived
    np.testing.assert_array_equal(gbuffer.background, wanted.background)
    scale = 0.01 if "unreal" in name else 1
    off = np.abs(scale * gbuffer.attributes["position"] - wanted.attributes["position"])
    assert off.mean() < 1e-3
    assert np.abs(gbuffer.attributes["normal"] - wanted.attributes["normal"]).mean() < 1e-3
    if "unreal" in name:
        assert "16 bits of 'position_world'" in gbuffer.derived["position"]


def test_a_grey_channel_is_what_its_file_is_called():
    wanted = load_gbuffer(CASES / "canonical_foliage.exr", ("position",))
    gbuffer = load_gbuffer(CASES / "shot_depth_Y.exr", ("position",))
    there = ~(gbuffer.background | wanted.background)
    off = gbuffer.attributes["position"] - wanted.attributes["position"]
    assert np.abs(off[:, there]).max() < 1e-3
