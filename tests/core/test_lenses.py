"""What headers say of the lens, against matrices made from one; and lenses that errors name."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.core.test_checks import CAMERA, NEEDS, H, N, P, W, Z, encode

from deepshade.camera import Camera
from deepshade.errors import CameraError, ContradictionError
from deepshade.gbuffer import load_gbuffer
from deepshade.gbuffer.lenses import Lens, lens_in

DISPLAY = (0, 0, W - 1, H - 1)
FOV = 50.0
VIEW = Camera.look_at((3, 2, 5), (0.2, 0.1, 0), (0, 1, 0), FOV, W, H)


def projected(camera: Camera, reach: float, *, down: bool, pbrt: bool = False) -> np.ndarray:
    """worldToNDC for columns: x and y over the frame go to reach / 2 either side of the middle."""
    half = np.tan(np.radians(camera.fov) / 2)
    wide, tall = half, half * H / W
    if pbrt:  # the shorter side is what the range spans
        wide = tall
    middle = 0.5 if reach == 1 else 0.0
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = reach / 2 / wide, (-1 if down else 1) * reach / 2 / tall
    matrix[0, 2] = matrix[1, 2] = -middle
    matrix[2] = matrix[3] = 0, 0, -1, 0
    matrix[2, 3] = -0.1
    return matrix @ camera.matrix


@pytest.mark.parametrize("transposed", [False, True], ids=["rows", "columns"])
@pytest.mark.parametrize(("reach", "down"), [(1, True), (1, False), (2, False), (2, True)])
def test_world_to_ndc(reach, down, transposed):
    matrices = {"worldToCamera": VIEW.matrix, "worldToNDC": projected(VIEW, reach, down=down)}
    header = {name: m if transposed else m.T for name, m in matrices.items()}
    found = lens_in(header, DISPLAY)
    assert found
    assert (found.projection, round(found.width, 4)) == ("perspective", FOV)


def test_pbrt_spans_the_shorter_side():
    ndc = projected(VIEW, 1, down=False, pbrt=True)
    header = {"worldToCamera": VIEW.matrix, "worldToNDC": ndc, "renderTimeSeconds": 1.0}
    found = lens_in(header, DISPLAY)
    assert found
    assert found.width == pytest.approx(FOV, abs=1e-3)


def test_an_orthographic_matrix():
    ndc = np.diag([2 / 6.0, 2 / (6.0 * H / W), 0.1, 1.0]) @ VIEW.matrix
    found = lens_in({"worldToCamera": VIEW.matrix.T, "worldToNDC": ndc.T}, DISPLAY)
    assert found
    assert (found.projection, round(found.width, 4)) == ("orthographic", 6)
    # the camera's matrix written twice says nothing
    assert lens_in({"worldToCamera": VIEW.matrix.T, "worldToNDC": VIEW.matrix.T}, DISPLAY) is None


@pytest.mark.parametrize(
    "header",
    [
        {"fieldOfViewHorizontal": FOV},
        {"CameraFov": FOV},
        {
            "pinholeFocalLength": 18 / np.tan(np.radians(FOV / 2)),
            "sensorOverallDimensions": (36, 24),
        },
        {"focalLength": 10.4775 / np.tan(np.radians(FOV / 2)), "horizontalAperture": 20.955},
        {
            "CameraFocalLength": 0.5 / np.tan(np.radians(FOV / 2)),
            "CameraFilmApertureHorizontal": 1.0,
        },
        {"screenWindowWidth": 2 * np.tan(np.radians(FOV / 2))},
    ],
)
def test_angles_and_films(header):
    found = lens_in(header, DISPLAY)
    assert found
    assert found.width == pytest.approx(FOV)


@pytest.mark.parametrize(
    "header",
    [
        {},
        {"screenWindowWidth": 1.0},
        {"deepshade:fov": "wide"},
        {"deepshade:fov": 190.0},
        {"deepshade:ortho_width": -1.0},
        {"worldToNDC": np.eye(4), "worldToCamera": np.zeros((4, 4))},
        {"worldToNDC": np.full((4, 4), np.nan), "worldToCamera": np.eye(4)},
        {"worldToNDC": "camera", "worldToCamera": np.eye(4)},
        {"pinholeFocalLength": 35.0},
        {"pinholeFocalLength": 0.0, "sensorOverallDimensions": (36.0, 24.0)},
    ],
)
def test_what_says_nothing(header):
    assert lens_in(header, DISPLAY) is None


def test_a_panorama_s_header():
    assert lens_in({"envmap": 0, "deepshade:fov": 90.0}, DISPLAY) == Lens("latlong", 360.0)


@pytest.mark.parametrize("value", [np.zeros((3, 3), np.float32), "latlong", 0.5])
def test_what_is_no_envmap_by_that_name_says_nothing(value: Any) -> None:
    found = lens_in({"envmap": value, "deepshade:fov": 90.0}, DISPLAY)
    assert found == Lens("perspective", 90.0)


def test_a_header_that_nobody_needs_blocks_nothing():
    broken = {"worldToCamera": np.zeros((4, 4), np.float32)}
    gbuffer = load_gbuffer(encode(broken, normal=N, position=P), NEEDS)
    np.testing.assert_array_equal(gbuffer.attributes["normal"], N)
    with pytest.raises(CameraError, match=r"(?s)matrix.*can't be inverted"):
        load_gbuffer(encode(broken, normal_world=N, position_world=P), NEEDS)


def flat(width: float) -> tuple[np.ndarray, np.ndarray]:
    """(normals, depth) of waves that parallel rays see, `width` across."""
    camera = Camera(0, W, H, projection="orthographic", across=width)
    x, y, _ = camera.points_at(np.arange(W)[None], np.arange(H)[:, None], np.zeros((H, W)))
    depth = 8 + 0.3 * np.sin(2 * x) * np.cos(1.5 * y) + 0.4 * x - 0.2 * y
    across = 0.6 * np.cos(2 * x) * np.cos(1.5 * y) + 0.4
    up = -0.45 * np.sin(2 * x) * np.sin(1.5 * y) - 0.2
    normal = np.stack([across, up, np.ones_like(x)])
    return normal / np.sqrt((normal**2).sum(0)), depth


def option(text: str, name: str) -> float:
    found = re.search(rf"--{name} ([\d.]+)", text)
    assert found, text
    return float(found[1])


def test_the_width_of_an_orthographic_frame_is_found():
    normal, depth = flat(6.0)
    body = encode({"deepshade:fov": "unknown"}, normal=normal, Z=depth)
    with pytest.raises(CameraError) as caught:
        load_gbuffer(body, NEEDS)
    assert "--projection orthographic" in caught.value.fix
    width = option(caught.value.fix, "ortho-width")
    assert width == pytest.approx(6, rel=0.02)
    gbuffer = load_gbuffer(body, NEEDS, projection="orthographic", ortho_width=width)
    assert "orthographic" in gbuffer.warnings[0]
    points = gbuffer.attributes["position"]
    np.testing.assert_allclose(points[0, 0, [0, -1]], [-width / 2, width / 2], rtol=0.02)
    np.testing.assert_allclose(points[2], -depth, rtol=1e-6)
    # positions of such a camera need no width
    stored = load_gbuffer(encode(normal=normal, position=points), NEEDS)
    assert "orthographic" in stored.warnings[0]


def test_the_field_of_view_is_found():
    body = encode({"deepshade:fov": "unknown"}, normal=N, Z=Z)
    with pytest.raises(CameraError) as caught:
        load_gbuffer(body, NEEDS)
    assert option(caught.value.fix, "fov") == pytest.approx(FOV, abs=0.5)


@pytest.mark.parametrize("fov", [15, 110])
def test_another_field_of_view_is_not_taken_for_other_axes(fov):
    try:
        gbuffer = load_gbuffer(encode(normal=N, Z=Z), NEEDS, fov=fov)
    except ContradictionError as error:
        assert option(error.fix, "fov") == pytest.approx(FOV, abs=0.5)
    else:
        assert "normal" not in gbuffer.derived
        assert "depth" not in gbuffer.derived


def test_a_panorama_is_unprojected():
    around = Camera(0, W, H, projection="latlong")
    rays = around.rays()
    np.testing.assert_allclose((rays**2).sum(0), 1, rtol=1e-6)
    np.testing.assert_allclose(rays[:, H // 2, W // 2], [0, 0, -1], atol=0.1)
    distance = 3 / np.abs(rays).max(0)  # a cube of side 6, from its middle
    axis = np.abs(rays).argmax(0)
    normal = np.where(np.arange(3)[:, None, None] == axis, -np.sign(rays), 0)
    body = encode({"deepshade:fov": "no"}, normal=normal, distance=distance)
    gbuffer = load_gbuffer(body, NEEDS, projection="latlong")
    np.testing.assert_allclose(np.abs(gbuffer.attributes["position"]).max(0), 3, rtol=1e-5)
    assert not gbuffer.warnings
    with pytest.raises(ContradictionError, match="panorama"):
        load_gbuffer(encode(normal=N, position=P), NEEDS, projection="latlong")


def test_cameras_of_other_projections_say_so():
    for camera in (replace(CAMERA, projection="orthographic", across=6.0),):
        said = lens_in(camera.to_header(), DISPLAY)
        assert said == Lens("orthographic", 6.0)
    with pytest.raises(CameraError, match="orthographic"):
        Camera(0, W, H, projection="orthographic")
