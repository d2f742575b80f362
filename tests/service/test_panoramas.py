"""A panorama of a room against flat pictures of the same room, and as six views in between."""

from __future__ import annotations

import numpy as np
import pytest

from deepshade import exr
from deepshade.camera import Camera
from deepshade.exr.entries import Entry
from deepshade.gbuffer import GBuffer
from deepshade_service.panoramas import FOV, faces

EXR = {"Content-Type": "image/x-exr"}
W, H = 128, 64
AROUND = Camera(0, W, H, projection="latlong")
SIDES = np.array([3.0, 2.0, 4.0])  # half of each, of a room seen from its middle
PANORAMA = {"envmap": Entry("envmap", b"\0")}


def room(rays):
    """(positions, normals) of the room's walls along directions (3, H, W), float32."""
    near = (SIDES[:, None, None] / np.maximum(np.abs(rays), 1e-9)).min(0)
    points = rays * near
    wall = (np.abs(points) / SIDES[:, None, None]).argmax(0)
    normal = np.where(np.arange(3)[:, None, None] == wall, -np.sign(rays), 0)
    return points.astype(np.float32), normal.astype(np.float32)


def channels(rays):
    points, normals = room(rays)
    vectors = {"position": points, "normal": normals}
    return {
        f"{name}.{axis}": plane
        for name, array in vectors.items()
        for axis, plane in zip("XYZ", array, strict=True)
    }


def answer(client, body, query=""):
    return client.post(f"/shade/ao?radius=1&{query}", content=body, headers=EXR)


def test_what_lies_ahead_is_shaded_as_a_flat_picture(client, make_exr):
    found = answer(client, make_exr(channels(AROUND.rays()), attributes=PANORAMA))
    assert found.status_code == 200, found.text
    around = exr.read(found.content).pixels["Y"]
    part = exr.read_header(found.content).parts[0]
    assert part.attributes["envmap"] == 0  # it is one too
    size = 90
    flat = Camera(FOV, size, size)
    body = make_exr(channels(flat.rays()), attributes=flat.to_header())
    wanted = exr.read(answer(client, body).content).pixels["Y"]
    rays = AROUND.rays()
    ahead = -rays[2] > 0.85
    right, up = rays[0][ahead] / -rays[2][ahead], rays[1][ahead] / -rays[2][ahead]
    half = np.tan(np.radians(FOV / 2))
    columns = ((right / half + 1) / 2 * size).astype(int)
    rows = ((1 - up / half) / 2 * size).astype(int)
    off = np.abs(around[ahead] - wanted[rows, columns])
    assert off.mean() < 0.01 < wanted.std()
    # without a header it can be said
    said = answer(client, make_exr(channels(AROUND.rays())), "projection=latlong")
    np.testing.assert_array_equal(exr.read(said.content).pixels["Y"], around)


def test_every_pixel_is_of_one_face_and_lies_where_it_looks():
    points, normals = room(AROUND.rays())
    empty = np.zeros((H, W), np.bool_)
    gbuffer = GBuffer({"position": points, "normal": normals}, empty, AROUND)
    count = np.zeros((H, W), int)
    for face in faces(gbuffer):
        count += face.of
        seen = face.gbuffer
        assert seen.camera
        rays = seen.camera.rays()
        position, normal = seen.attributes["position"], seen.attributes["normal"]
        np.testing.assert_allclose(position / -position[2], rays, atol=1e-5)
        assert ((normal * rays).sum(0) < 0).mean() > 0.97  # but at the corners between walls
        distance = np.sqrt((points[:, face.of] ** 2).sum(0))
        there = np.sqrt((position[:, *face.at] ** 2).sum(0))
        np.testing.assert_allclose(there, distance, rtol=0.1)
    assert (count == 1).all()


def test_a_radius_follows_from_the_distance(client, make_exr):
    body = make_exr(channels(AROUND.rays()), attributes=PANORAMA)
    found = client.post("/shade/ao?explain=1", content=body, headers=EXR).json()
    points, _ = room(AROUND.rays())
    median = np.median(np.sqrt((points**2).sum(0)))
    assert found["radius"] == pytest.approx(0.15 * median, rel=0.05)
