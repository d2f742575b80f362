"""The camera against hand-computed geometry, and its round trip through an EXR header."""

import io
import math

import numpy as np
import pytest

from deepshade import exr
from deepshade.camera import Camera, camera_to_world, matrix_from_header, rotation_of
from deepshade.errors import CameraError


def test_rays_of_a_2x1_frame_by_hand():
    # 90 degrees: the frame is 2 wide at distance 1, its pixel centres are at -1/2 and 1/2
    rays = Camera(90, 2, 1).rays()
    np.testing.assert_allclose(rays[:, 0, 0], [-0.5, 0, -1], atol=1e-7)
    np.testing.assert_allclose(rays[:, 0, 1], [0.5, 0, -1], atol=1e-7)


def test_row_zero_is_the_top():
    rays = Camera(60, 4, 6).rays()
    assert rays[1, 0, 0] > 0 > rays[1, -1, 0]


def test_field_of_view_is_the_full_horizontal_angle():
    width = 1000
    rays = Camera(50, width, 10).rays().astype(np.float64)
    half_pixel = math.tan(math.radians(25)) / width
    assert math.degrees(2 * math.atan(rays[0, 0, -1] + half_pixel)) == pytest.approx(50, abs=1e-4)


def test_a_data_window_is_a_cut_of_the_frame():
    whole = Camera(40, 20, 16).rays()
    cut = Camera(40, 20, 16, x0=5, y0=3).rays(7, 4)
    np.testing.assert_array_equal(cut, whole[:, 3:7, 5:12])
    outside = Camera(40, 20, 16, x0=-2, y0=-1).rays(24, 18)
    np.testing.assert_array_equal(outside[:, 1:17, 2:22], whole)


def test_look_at_puts_the_target_ahead_and_up_above():
    camera = Camera.look_at((1, 2, 3), (4, 6, 3), (0, 0, 1), 50, 8, 8)
    target = camera.matrix @ (4, 6, 3, 1)
    np.testing.assert_allclose(target, [0, 0, -5, 1], atol=1e-12)
    above = camera.matrix @ (1, 2, 4, 1)
    np.testing.assert_allclose(above, [0, 1, 0, 1], atol=1e-12)
    np.testing.assert_allclose(camera.eye, [1, 2, 3], atol=1e-12)
    assert np.linalg.det(camera.matrix[:3, :3]) == pytest.approx(1)


def test_look_at_straight_down_still_works():
    camera = Camera.look_at((0, 5, 0), (0, 0, 0), (0, 1, 0), 50, 8, 8)
    linear = camera.matrix[:3, :3]
    np.testing.assert_allclose(linear @ linear.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("fov", [0, 5e-324, 180, -5, math.nan, math.inf])
def test_refuses_impossible_angles(fov):
    with pytest.raises(CameraError):
        Camera(fov, 8, 8)


def test_refuses_a_camera_at_its_target():
    with pytest.raises(CameraError):
        Camera.look_at((1, 1, 1), (1, 1, 1), (0, 1, 0), 50, 8, 8)


@pytest.mark.parametrize(
    "matrix",
    [np.zeros((4, 4)), np.full((4, 4), np.nan), np.eye(4)[[0, 0, 2, 3]], np.ones(7), "text"],
)
def test_refuses_unusable_matrices(matrix):
    with pytest.raises(CameraError):
        matrix_from_header({"worldToCamera": matrix})


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_a_scaled_matrix_is_fine_and_its_rotation_is_rigid(scale):
    matrix = Camera.look_at((1, 2, 3), (0, 0, 0), (0, 1, 0), 50, 8, 8).matrix.copy()
    rotation = matrix[:3, :3].copy()
    matrix[:3] *= scale
    matrix = matrix_from_header({"worldToCamera": matrix.T})
    assert matrix is not None
    np.testing.assert_allclose(rotation_of(matrix), rotation, atol=1e-6)


def test_header_round_trip_through_a_file():
    camera = Camera.look_at((1, -2, 3), (0, 0.5, 0), (0, 1, 0), 37.5, 64, 48)
    body = io.BytesIO()
    exr.write(
        body,
        {"Z": np.ones((10, 12), np.float32)},
        attributes=camera.to_header(),
        data_window=(-3, 40, 8, 49),
        display_window=(0, 0, 63, 47),
    )
    part = exr.read_header(body.getvalue()).parts[0]
    back = Camera.from_header(part.attributes, part.data_window, part.display_window)
    assert back is not None
    assert (back.fov, back.width, back.height, back.x0, back.y0) == (37.5, 64, 48, -3, 40)
    np.testing.assert_allclose(back.matrix, camera.matrix, atol=1e-6)
    # OpenEXR multiplies row vectors: the translation is the stored matrix's last row
    np.testing.assert_allclose(part.attributes["worldToCamera"][3, :3], camera.matrix[:3, 3])


def test_no_angle_in_the_header_is_no_camera():
    window = (0, 0, 7, 7)
    assert Camera.from_header({"screenWindowWidth": 1.0}, window, window) is None
    found = Camera.from_header({"screenWindowWidth": 2.0}, window, window)
    assert found is not None
    assert found.fov == pytest.approx(90)


def test_position_from_depth_has_that_depth():
    depth = np.array([[1.0, 2.0], [np.inf, 4.0]], np.float32)
    position = Camera(50, 2, 2).position_from_depth(depth)
    np.testing.assert_array_equal(-position[2], depth)


def turned(seed, mirror=1.0):
    """A random orthogonal matrix of that determinant."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    matrix[0] *= mirror * np.sign(np.linalg.det(matrix))
    return matrix


def normals(directions, turn):
    """Attributes of a picture of 16 x 24 that shows these directions (N, 3), and nothing."""
    seen = np.zeros((3, 16, 24), np.float32)
    chosen = np.arange(16 * 20) % 7 % len(directions)
    seen[:, :, :20] = np.asarray(directions)[chosen].T.reshape(3, 16, 20)
    there = np.tensordot(turn, seen, 1).astype(np.float32)
    return {"normal": seen, "normal_world": there * np.float32(0.9)}


@pytest.mark.parametrize("mirror", [1, -1])
def test_two_normals_of_a_pixel_tell_how_the_camera_is_turned(mirror):
    """A world that is left-handed too; the file's own matrix is not asked."""
    turn = turned(1, mirror)
    other = Camera.look_at((1, 2, 3), (0, 0, 0), (0, 1, 0), 50, 24, 16)
    found = camera_to_world(normals(np.eye(3), turn), other)
    np.testing.assert_allclose(found, turn, atol=1e-6)


def test_of_a_floor_and_a_wall_the_third_axis_follows():
    found = camera_to_world(normals(np.eye(3)[:2], turned(2)))
    np.testing.assert_allclose(found, turned(2), atol=1e-6)


def test_a_flat_wall_leaves_it_to_the_matrix():
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), (0, 1, 0), 50, 24, 16)
    wall = normals([(0, 0.6, 0.8)], turned(3))
    found = camera_to_world(wall, camera)
    np.testing.assert_allclose(found, rotation_of(camera.matrix).T, atol=1e-12)
    alone = camera_to_world(wall)
    np.testing.assert_allclose(alone @ [0, 0.6, 0.8], turned(3) @ [0, 0.6, 0.8], atol=1e-6)
    np.testing.assert_allclose(alone @ alone.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(camera_to_world({}, camera), rotation_of(camera.matrix).T)
